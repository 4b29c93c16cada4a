-- Whatever changes of a row in an index, the database writes into every index of the table. So nothing is indexed that
-- changes while a job is leased, or that a look at few rows finds as well.
drop index jobs_expiring;
drop index jobs_of_worker;
drop index versions_by_digest;
drop index aliases_of_version;

-- When a job of the collection was last leased, instead of an index of all starts.
alter table collections add column served_at timestamptz;
update collections set served_at = (select max(started_at) from jobs where jobs.collection = collections.name);
drop index jobs_started;

-- What may change of an object is asked for at every publication.
create index versions_retired on versions (collection, object) where retired;

-- Room on each page for the next state of its rows: a report then writes no index at all.
alter table jobs set (fillfactor = 80);
