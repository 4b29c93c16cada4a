//! Every target on its corpus and on mutations of it, on the stable toolchain.

use ign_fuzz::{corpus, replay, targets};

macro_rules! replays {
    ($($name:ident),* $(,)?) => {
        $(#[test]
        fn $name() {
            let target = targets::ALL.iter().find(|target| target.name == stringify!($name));
            let target = target.expect("a target");
            replay(target, &corpus(target));
        })*

        #[test]
        fn every_target_is_replayed() {
            let replayed = [$(stringify!($name)),*];
            for target in targets::ALL {
                assert!(replayed.contains(&target.name), "{}", target.name);
            }
        }
    };
}

replays!(
    colmap_cameras_txt,
    colmap_images_txt,
    colmap_points_txt,
    colmap_cameras_bin,
    colmap_images_bin,
    colmap_points_bin,
    capture_toml,
    test_txt,
    photograph,
    mask,
    mesh_ply,
    mesh_obj,
    bundle_json,
    bundle_metrics,
    bundle_views,
    bundle_image,
    bundle_proxy,
    bundle_weights,
    oci_manifest,
    ids,
    events,
    job,
);
