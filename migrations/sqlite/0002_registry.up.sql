-- A registry rebuilt from the bucket has versions whose jobs are gone, and a version knows when it was retired: its
-- files stay for a grace period after that (null where an older coordinator did it). SQLite cannot drop a constraint,
-- so the table is made anew; the aliases that point into it are set aside meanwhile.
create table aliases_aside as select * from aliases;
delete from aliases;

create table versions_anew (
    collection text not null,
    object text not null,
    version integer not null check (version >= 1),
    manifest_digest text not null,
    size_bytes integer not null,
    file_count integer not null,
    metrics_json text not null,
    job_id text not null,
    created_at integer not null,
    retired integer not null default 0,
    retired_at integer,
    primary key (collection, object, version),
    -- A job publishes at most once.
    unique (job_id),
    foreign key (collection, object) references objects (collection, object)
) strict;
insert into versions_anew
select collection, object, version, manifest_digest, size_bytes, file_count, metrics_json, job_id, created_at, retired,
    case when retired then cast(unixepoch('subsec') * 1000000 as integer) end
from versions;
drop table versions;
alter table versions_anew rename to versions;
create index versions_by_digest on versions (collection, object, manifest_digest);

insert into aliases select * from aliases_aside;
drop table aliases_aside;

-- What happened to the registry: collections of garbage, audits, damage, repairs.
create table events (
    seq integer primary key autoincrement,
    at integer not null,
    kind text not null,
    subject text not null,
    message text not null
) strict;

-- Work that one coordinator at a time does every so often.
create table turns (
    name text primary key,
    last_at integer not null,
    count integer not null
) strict;
