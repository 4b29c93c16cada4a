//! Compiles the contract of the last release, so that a test can speak as its programs did.

use std::error::Error;

const RELEASED: &str = "../proto/tests/frozen/0.1.0";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed={RELEASED}");
    let descriptors = protox::compile(["ign/v1/ign.proto"], [RELEASED])?;
    tonic_prost_build::configure()
        .build_server(false)
        .compile_fds(descriptors)?;
    Ok(())
}
