//! The target that this binary is named after, under libFuzzer.

#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    ign_fuzz::run(ign_fuzz::target(env!("CARGO_BIN_NAME")), bytes);
});
