drop table turns;
drop table events;
alter table versions drop column retired_at;

-- The older program wants a job behind every version.
insert into collections (name) select distinct collection from versions on conflict do nothing;
insert into jobs (id, collection, object, request_id, capture_digest, recipe_json, priority, labels, max_attempts,
    state, attempt, attempt_limit, cancel_requested, version, submitted_at, not_before, started_at, finished_at)
select v.job_id, v.collection, v.object, 'rebuilt-' || v.job_id, v.manifest_digest, '{}', 0, '{}', 1,
    'succeeded', 1, 1, false, v.version, v.created_at, v.created_at, v.created_at, v.created_at
from versions v where not exists (select 1 from jobs j where j.id = v.job_id);
alter table versions add constraint versions_job_id_fkey foreign key (job_id) references jobs (id);
