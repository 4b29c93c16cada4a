-- Where a collection's events are sent, and what signs them. The secret must be kept as it is: a hash cannot sign.
create table webhooks (
    collection text primary key references collections (name),
    url text not null,
    secret bytea not null,
    set_at timestamptz not null
);

-- What is to be sent, written in the transaction of the change that it tells of; and what became of it.
create table deliveries (
    id text primary key,
    collection text not null,
    job_id uuid not null,
    attempt bigint not null,
    event text not null,
    body text not null,
    state text not null check (state in ('pending', 'delivered', 'given_up')),
    tries bigint not null default 0,
    created_at timestamptz not null,
    -- Pending: not before this time.
    next_at timestamptz not null,
    ended_at timestamptz,
    last_error text,
    unique (job_id, attempt),
    check ((state = 'pending') = (ended_at is null))
);

create index deliveries_due on deliveries (next_at) where state = 'pending';
create index deliveries_ended on deliveries (ended_at) where state <> 'pending';
create index deliveries_of_collection on deliveries (collection, created_at);
