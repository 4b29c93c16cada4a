//! ignctl.
fn main() {}
