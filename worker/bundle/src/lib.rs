//! The bundle manifest ign.bundle/1: pack, verify, read.
