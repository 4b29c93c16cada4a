//! Every target on its corpus and on mutations of it, on the stable toolchain.

use ign_fuzz::{corpus, replay, target};

macro_rules! replays {
    ($($name:ident),*) => {
        $(#[test]
        fn $name() {
            let target = target(stringify!($name));
            replay(target, &corpus(target));
        })*
    };
}

ign_fuzz::for_all_targets!(replays);

/// `cargo fuzz` finds the targets in the manifest of its crate.
#[test]
fn cargo_fuzz_has_a_binary_for_every_target() {
    let manifest = include_str!("../fuzz/Cargo.toml");
    let binaries: Vec<&str> = manifest
        .lines()
        .filter_map(|line| line.trim().strip_prefix("{ name = \"")?.split('"').next())
        .collect();
    let targets: Vec<&str> = ign_fuzz::targets::ALL
        .iter()
        .map(|target| target.name)
        .collect();
    assert_eq!(binaries, targets);
}
