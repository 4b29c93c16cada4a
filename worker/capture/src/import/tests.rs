//! Faults of a capture folder, one by one.
