alter table jobs reset (fillfactor);
drop index versions_retired;
create index jobs_started on jobs (collection, started_at) where started_at is not null;
alter table collections drop column served_at;
create index aliases_of_version on aliases (collection, object, version);
create index versions_by_digest on versions (collection, object, manifest_digest);
create index jobs_of_worker on jobs (worker) where state = 'leased';
create index jobs_expiring on jobs (lease_until) where state = 'leased';
