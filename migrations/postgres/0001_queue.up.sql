-- Jobs, workers, collections and published versions. Rules live in ign-queue's state machine; the constraints here are
-- the ones that must hold even if that code were wrong.

create table collections (
    name text primary key,
    weight double precision not null default 1.0 check (weight > 0),
    max_running bigint not null default 0 check (max_running >= 0),
    paused boolean not null default false
);

create table jobs (
    id uuid primary key,
    collection text not null references collections (name),
    object text not null,
    request_id text not null,
    capture_digest text not null,
    recipe_json text not null,
    priority bigint not null,
    labels jsonb not null,
    max_attempts bigint not null check (max_attempts >= 1),
    state text not null check (state in ('queued', 'leased', 'succeeded', 'failed', 'cancelled')),
    attempt bigint not null check (attempt >= 1),
    attempt_limit bigint not null,
    worker text,
    cancel_requested boolean not null,
    progress jsonb,
    failure jsonb,
    checkpoint_digest text,
    checkpoint_bytes bigint,
    version bigint,
    submitted_at timestamptz not null,
    not_before timestamptz not null,
    started_at timestamptz,
    finished_at timestamptz,
    lease_until timestamptz,
    -- Last sequence number of the job's log; how far the log of which attempt's worker was taken over.
    log_seq bigint not null default 0,
    log_source_attempt bigint not null default 0,
    log_source_seq bigint not null default 0,
    unique (collection, request_id),
    check ((state = 'leased') = (lease_until is not null)),
    check ((state = 'succeeded') = (version is not null)),
    check ((state in ('succeeded', 'failed', 'cancelled')) = (finished_at is not null))
);

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
create index jobs_labels on jobs using gin (labels jsonb_path_ops);

create table job_logs (
    job_id uuid not null references jobs (id) on delete cascade,
    seq bigint not null,
    at timestamptz not null,
    attempt bigint not null,
    level text not null,
    message text not null,
    primary key (job_id, seq)
);

create table workers (
    id text primary key,
    hostname text not null,
    version text not null,
    device text not null,
    last_seen_at timestamptz not null,
    draining boolean not null default false
);

-- One row per object that has versions: its lock orders publications.
create table objects (
    collection text not null,
    object text not null,
    last_version bigint not null,
    primary key (collection, object)
);

create table versions (
    collection text not null,
    object text not null,
    version bigint not null check (version >= 1),
    manifest_digest text not null,
    size_bytes bigint not null,
    file_count bigint not null,
    metrics_json text not null,
    job_id uuid not null references jobs (id),
    created_at timestamptz not null,
    retired boolean not null default false,
    primary key (collection, object, version),
    -- A job publishes at most once.
    unique (job_id),
    foreign key (collection, object) references objects (collection, object)
);

create index versions_by_digest on versions (collection, object, manifest_digest);

create table aliases (
    collection text not null,
    object text not null,
    alias text not null,
    version bigint not null,
    primary key (collection, object, alias),
    foreign key (collection, object, version) references versions (collection, object, version)
);

create index aliases_of_version on aliases (collection, object, version);
