-- W3C trace context of the call that submitted the job: its workers' spans belong to the same trace.
alter table jobs add column traceparent text;
