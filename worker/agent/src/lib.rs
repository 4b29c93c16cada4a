//! Worker agent: lease, heartbeat, transfer, and supervision of one child process per job.
