drop table aliases;
drop table versions;
drop table objects;
drop table workers;
drop table job_logs;
drop table jobs;
drop table collections;
