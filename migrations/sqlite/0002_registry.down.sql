drop table turns;
drop table events;

-- The older program wants a job behind every version.
insert into collections (name) select distinct collection from versions where true on conflict do nothing;
insert into jobs (id, collection, object, request_id, capture_digest, recipe_json, priority, labels, max_attempts,
    state, attempt, attempt_limit, cancel_requested, version, submitted_at, not_before, started_at, finished_at)
select v.job_id, v.collection, v.object, 'rebuilt-' || v.job_id, v.manifest_digest, '{}', 0, '{}', 1,
    'succeeded', 1, 1, 0, v.version, v.created_at, v.created_at, v.created_at, v.created_at
from versions v where not exists (select 1 from jobs j where j.id = v.job_id);

create table aliases_aside as select * from aliases;
delete from aliases;

create table versions_before (
    collection text not null,
    object text not null,
    version integer not null check (version >= 1),
    manifest_digest text not null,
    size_bytes integer not null,
    file_count integer not null,
    metrics_json text not null,
    job_id text not null references jobs (id),
    created_at integer not null,
    retired integer not null default 0,
    primary key (collection, object, version),
    -- A job publishes at most once.
    unique (job_id),
    foreign key (collection, object) references objects (collection, object)
) strict;
insert into versions_before
select collection, object, version, manifest_digest, size_bytes, file_count, metrics_json, job_id, created_at, retired
from versions;
drop table versions;
alter table versions_before rename to versions;
create index versions_by_digest on versions (collection, object, manifest_digest);

insert into aliases select * from aliases_aside;
drop table aliases_aside;
