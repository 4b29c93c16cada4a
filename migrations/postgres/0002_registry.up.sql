-- A registry rebuilt from the bucket has versions whose jobs are gone.
alter table versions drop constraint versions_job_id_fkey;

-- When a version was retired: its files stay for a grace period after that. Null where an older coordinator did it.
alter table versions add column retired_at timestamptz;
update versions set retired_at = clock_timestamp() where retired;

-- What happened to the registry: collections of garbage, audits, damage, repairs.
create table events (
    seq bigint generated always as identity primary key,
    at timestamptz not null,
    kind text not null,
    subject text not null,
    message text not null
);

-- Work that one coordinator at a time does every so often.
create table turns (
    name text primary key,
    last_at timestamptz not null,
    count bigint not null
);
