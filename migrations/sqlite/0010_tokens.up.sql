-- Bearer tokens. Secrets are kept as SHA-256 alone: they hold 256 random bits, so there is nothing to guess.
create table tokens (
    id text primary key,
    name text not null,
    -- ["submit:museum", "read:*"]
    grants text not null,
    secret_sha256 blob not null,
    -- After a rotation, for its grace.
    previous_sha256 blob,
    previous_until integer,
    created_at integer not null,
    expires_at integer,
    revoked_at integer,
    last_used_on text
) strict;

create unique index tokens_by_name on tokens (name) where revoked_at is null;
