//! The report of a collection: what comes first, what stands out, and a page that says so.
//!
//! To look at it: `IGN_REPORT_OUT=/tmp/collection.html cargo test -p ign-bundle --test collection`, then open the file.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use ign_bundle::Metrics;
use ign_bundle::report::{
    CollectionInput, CollectionObject, Need, WithoutBundle, rank, render_collection,
};
use serde_json::{Value, json};

fn method(name: &str, mse: f64) -> Value {
    let view = |name: &str, factor: f64| json!({"name": name, "mse": factor * mse, "mse_object": 2.5 * factor * mse});
    json!({
        "name": name, "mse": mse, "mse_object": 2.5 * mse, "psnr": 30.0, "psnr_object": 27.0, "ssim": 0.95, "flip": 0.05,
        "worst_view": {"name": "0008.jpg", "mse": 1.2 * mse},
        "per_view": [view("0001.jpg", 0.8), view("0008.jpg", 1.2)],
        "train_secs": 140.0, "render_ms": 21.0, "bundle_bytes": 5_000_000
    })
}

fn object(name: &str, ours: f64, ibr: f64, faults: &Value) -> CollectionObject {
    let metrics = json!({
        "schema": "ign.metrics/1", "capture": "sha256:0", "resolution": [128, 128],
        "views": {"train": 40, "held_out": 2, "references": 20},
        "methods": [method("ibr", ibr), method("ours", ours)],
        "speed_error": [], "plan": {"preflight": {"faults": faults}}, "stages": [], "device": "cpu"
    });
    let picture = image::RgbImage::from_fn(96, 72, |x, y| {
        image::Rgb([(40 + x) as u8, (60 + y) as u8, (ours.min(200.0)) as u8])
    });
    let mut jpeg = std::io::Cursor::new(Vec::new());
    picture
        .write_to(&mut jpeg, image::ImageFormat::Jpeg)
        .unwrap();
    CollectionObject {
        object: name.into(),
        version: 2,
        size_bytes: 6_000_000,
        metrics: serde_json::from_value::<Metrics>(metrics).unwrap(),
        thumbnail: Some(jpeg.into_inner()),
    }
}

fn collection() -> Vec<CollectionObject> {
    let none = json!([]);
    let light = json!([{
        "severity": "warning", "message": "the light moves with the object", "at": "images",
        "hint": "photograph it again with lamps that stay with the table"
    }]);
    vec![
        object("amphora", 9.0, 40.0, &none),
        object("bust", 7.5, 30.0, &none),
        object("bowl", 8.2, 35.0, &none),
        object("axe", 61.0, 90.0, &light),
        object("cup", 10.0, 9.0, &none),
        object("jug", 8.8, 36.0, &light),
        object("lamp <1>", 150.0, 300.0, &none),
        object("plate", 9.5, 39.0, &none),
    ]
}

#[test]
fn what_needs_attention_comes_first_with_its_reasons() {
    let objects = collection();
    let ranked = rank(&objects);
    let order: Vec<(&str, Need, bool)> = ranked
        .iter()
        .map(|ranked| (ranked.object.as_str(), ranked.need, ranked.outlier))
        .collect();
    assert_eq!(
        order,
        [
            ("axe", Need::Retake, true),
            ("cup", Need::Retake, false),
            ("lamp <1>", Need::Look, true),
            ("jug", Need::Look, false),
            ("plate", Need::Nothing, false),
            ("amphora", Need::Nothing, false),
            ("bowl", Need::Nothing, false),
            ("bust", Need::Nothing, false),
        ]
    );
    assert_eq!(
        ranked[0].reasons,
        [
            "Its error is 6.4 times the collection's median.",
            "The light moves with the object: photograph it again with lamps that stay with the table."
        ]
    );
    assert!(ranked[1].reasons[0].starts_with("No better than"));
    assert!(ranked[4].reasons.is_empty());
    // Few objects, or objects alike, have no outliers.
    assert!(rank(&objects[3..6]).iter().all(|ranked| !ranked.outlier));
    let alike: Vec<CollectionObject> = (0..9)
        .map(|at| {
            object(
                &format!("o{at}"),
                9.0 + 0.1 * f64::from(at),
                40.0,
                &json!([]),
            )
        })
        .collect();
    assert!(rank(&alike).iter().all(|ranked| !ranked.outlier));
}

#[test]
fn errors_that_are_none_rank_without_harm() {
    let none = json!([]);
    let mut objects = vec![
        object("zero", 0.0, 0.0, &none),
        object("fine", 3.0, 9.0, &none),
    ];
    objects[1].metrics.methods.clear();
    let ranked = rank(&objects);
    assert_eq!(ranked[0].need, Need::Retake, "{ranked:?}");
    assert!(rank(&[]).is_empty());
    let input = CollectionInput {
        collection: "museum",
        objects: &objects,
        without: &[],
        made_at: "",
    };
    let page = render_collection(&input, &ranked);
    assert!(!page.contains("NaN") && !page.contains("inf"), "{page}");
}

#[test]
fn the_page_is_self_contained_and_complete() {
    let objects = collection();
    let ranked = rank(&objects);
    let without = [WithoutBundle {
        object: "vase".into(),
        state: "failed".into(),
        reason: "the model names no camera: reconstruct it again".into(),
    }];
    let page = render_collection(
        &CollectionInput {
            collection: "museum",
            objects: &objects,
            without: &without,
            made_at: "Made 2026-11-25 17:00 UTC.",
        },
        &ranked,
    );
    if let Ok(path) = std::env::var("IGN_REPORT_OUT") {
        std::fs::write(path, &page).unwrap();
    }
    for wanted in [
        "Retake 2 objects, look at 2 more",
        "lamp &lt;1&gt;",
        "the model names no camera",
        "6.4 times the collection",
        "data:image/jpeg;base64,",
    ] {
        assert!(page.contains(wanted), "{wanted}");
    }
    assert!(!page.contains("lamp <1>"));
    assert!(!page.contains("http://") && !page.contains("https://") && !page.contains("<script"));
}
