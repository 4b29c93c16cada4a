-- Whose token or certificate took the lease of which attempt: nobody else reports about it. An older coordinator leases
-- without a holder, hence the attempt beside it.
alter table jobs add column holder text;
alter table jobs add column holder_attempt bigint;
