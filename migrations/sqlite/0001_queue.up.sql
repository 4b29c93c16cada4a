-- Jobs, workers, collections and published versions. Rules live in ign-queue's state machine; the constraints here are
-- the ones that must hold even if that code were wrong.
--
-- Times are microseconds since 1970 UTC; job ids are UUIDs in lower-case text, which sort as they were made.

create table collections (
    name text primary key,
    weight real not null default 1.0 check (weight > 0),
    max_running integer not null default 0 check (max_running >= 0),
    paused integer not null default 0
) strict;

create table jobs (
    id text primary key,
    collection text not null references collections (name),
    object text not null,
    request_id text not null,
    capture_digest text not null,
    recipe_json text not null,
    priority integer not null,
    labels text not null,
    max_attempts integer not null check (max_attempts >= 1),
    state text not null check (state in ('queued', 'leased', 'succeeded', 'failed', 'cancelled')),
    attempt integer not null check (attempt >= 1),
    attempt_limit integer not null,
    worker text,
    cancel_requested integer not null,
    progress text,
    failure text,
    checkpoint_digest text,
    checkpoint_bytes integer,
    version integer,
    submitted_at integer not null,
    not_before integer not null,
    started_at integer,
    finished_at integer,
    lease_until integer,
    -- Last sequence number of the job's log; how far the log of which attempt's worker was taken over.
    log_seq integer not null default 0,
    log_source_attempt integer not null default 0,
    log_source_seq integer not null default 0,
    unique (collection, request_id),
    check ((state = 'leased') = (lease_until is not null)),
    check ((state = 'succeeded') = (version is not null)),
    check ((state in ('succeeded', 'failed', 'cancelled')) = (finished_at is not null))
) strict;

-- The next job of a collection.
create index jobs_queued on jobs (collection, priority desc, submitted_at, id) where state = 'queued';
-- The queue over all collections.
create index jobs_next on jobs (priority desc, submitted_at, id) where state = 'queued';
-- Running jobs: for fairness, and for leases that ran out.
create index jobs_leased on jobs (collection) where state = 'leased';
create index jobs_expiring on jobs (lease_until) where state = 'leased';
create index jobs_of_worker on jobs (worker) where state = 'leased';
-- The collection that was served longest ago.
create index jobs_started on jobs (collection, started_at) where started_at is not null;
create index jobs_failed on jobs (finished_at) where state = 'failed';
create index jobs_of_object on jobs (collection, object, id);

create table job_logs (
    job_id text not null references jobs (id) on delete cascade,
    seq integer not null,
    at integer not null,
    attempt integer not null,
    level text not null,
    message text not null,
    primary key (job_id, seq)
) strict;

create table workers (
    id text primary key,
    hostname text not null,
    version text not null,
    device text not null,
    last_seen_at integer not null,
    draining integer not null default 0
) strict;

-- One row per object that has versions: its lock orders publications.
create table objects (
    collection text not null,
    object text not null,
    last_version integer not null,
    primary key (collection, object)
) strict;

create table versions (
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

create index versions_by_digest on versions (collection, object, manifest_digest);

create table aliases (
    collection text not null,
    object text not null,
    alias text not null,
    version integer not null,
    primary key (collection, object, alias),
    foreign key (collection, object, version) references versions (collection, object, version)
) strict;

create index aliases_of_version on aliases (collection, object, version);
