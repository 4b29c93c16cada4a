-- Bearer tokens. Secrets are kept as SHA-256 alone: they hold 256 random bits, so there is nothing to guess.
create table tokens (
    id text primary key,
    name text not null,
    -- ["submit:museum", "read:*"]
    grants jsonb not null,
    secret_sha256 bytea not null,
    -- After a rotation, for its grace.
    previous_sha256 bytea,
    previous_until timestamptz,
    created_at timestamptz not null,
    expires_at timestamptz,
    revoked_at timestamptz,
    last_used_on date
);

create unique index tokens_by_name on tokens (name) where revoked_at is null;
