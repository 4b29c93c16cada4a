//! Target views and reference sets at the edge of what can be rendered: every image is finite, in range, and black
//! where the object is not. Finite is tested before the compositing, which would replace what is not.

use ign_geometry::{Camera, Drawable, Mesh};
use ign_nets::Builder;
use ign_nets::composition::{BLEND_WIDTH, BlendComposition, PaperComposition};
use ign_nets::effects::{PaperEffects, PointEffects};
use ign_render::{
    ColorGrid, Composition, Effects, Model, Recipe, ReferenceImage, References, RenderSettings,
    SurfaceColors, Target, debevec_ibr, naive_ibr,
};
use ign_scenes::hard;
use tch::{Device, Tensor, no_grad};

/// A reference picture by `value` of (pixel, channel); opaque.
fn reference(name: &str, camera: Camera, value: impl Fn(usize, usize) -> u8) -> ReferenceImage {
    let i = camera.intrinsics;
    let rgba = (0..(i.width * i.height) as usize)
        .flat_map(|at| [value(at, 0), value(at, 1), value(at, 2), 255])
        .collect();
    ReferenceImage {
        name: name.into(),
        camera,
        rgba,
    }
}

fn reference_sets() -> Vec<(&'static str, Vec<ReferenceImage>)> {
    let ring = hard::ring();
    let all = |value: &dyn Fn(usize, usize) -> u8| {
        ring.iter()
            .map(|camera| reference("view", *camera, value))
            .collect::<Vec<_>>()
    };
    let mut with_blind = all(&hard::pattern);
    with_blind.push(reference("blind", hard::blind(), hard::pattern));
    let mut sets = vec![
        ("five views", all(&hard::pattern)),
        ("a view that sees nothing", with_blind),
        ("one view", all(&hard::pattern)[..1].to_vec()),
        (
            "the same view five times",
            vec![reference("copy", ring[0], hard::pattern); 5],
        ),
    ];
    sets.extend(
        hard::images()
            .into_iter()
            .skip(1)
            .map(|(what, value)| (what, all(&value))),
    );
    sets
}

fn model(mesh: &Mesh, images: &[ReferenceImage], recipe: Recipe) -> Model {
    let references = References::new(&Drawable::new(mesh), images, recipe, Device::Cpu);
    let settings = RenderSettings {
        recipe,
        ..RenderSettings::default()
    };
    let mut first = Builder::new();
    let mut second = Builder::new();
    let (effects, composition) = match recipe {
        Recipe::Paper => {
            let effects = PaperEffects::new(&mut first);
            let net =
                PaperComposition::new(&mut second, PaperComposition::input_channels(settings.k));
            (
                Effects::Paper(effects, first.build(Device::Cpu, 1)),
                Composition::Paper(net, second.build(Device::Cpu, 2)),
            )
        }
        Recipe::Standard => {
            let effects = PointEffects::new(&mut first);
            let net = BlendComposition::new(&mut second, settings.k, BLEND_WIDTH);
            let params = second.build(Device::Cpu, 2);
            no_grad(|| {
                let noise = params.flat().randn_like() * 0.05;
                drop(params.flat().shallow_clone().g_add_(&noise));
            });
            (
                Effects::Points(effects, first.build(Device::Cpu, 1)),
                Composition::Blend(net, params),
            )
        }
    };
    Model::new(references, settings, Some(effects), Some(composition))
}

fn assert_finite(what: &str, tensor: &Tensor) {
    assert_eq!(
        tensor.isfinite().all().int64_value(&[]),
        1,
        "{what} is not finite"
    );
}

fn assert_image(what: &str, image: &Tensor, target: &Target) {
    assert_finite(what, image);
    if image.numel() > 0 {
        assert!(
            image.min().double_value(&[]) >= 0.0 && image.max().double_value(&[]) <= 1.0,
            "{what}"
        );
        let outside = image * target.coverage.le(0.0).to_kind(image.kind());
        assert!(
            outside.abs().max().double_value(&[]) < 1e-12,
            "{what} paints outside the object"
        );
    }
}

#[test]
fn every_target_from_every_reference_set_is_finite_and_bounded() {
    let mesh = hard::object(20, 28);
    let proxy = Drawable::new(&mesh);
    tch::manual_seed(41);
    let mut painted = 0;
    for (set, images) in reference_sets() {
        for recipe in [Recipe::Standard, Recipe::Paper] {
            let model = model(&mesh, &images, recipe);
            // The paper's U-Nets take seconds for all sets; their input is what differs.
            let every = recipe == Recipe::Standard || set == "five views";
            let grids = [ColorGrid::Vertices, ColorGrid::Texels];
            let surfaces = grids.map(|grid| SurfaceColors::new(&mesh, &model.references, grid));
            for (view, camera) in hard::cameras() {
                let what = format!("{recipe:?}, {set}, {view}");
                let target = Target::new(&proxy, &camera, &model.settings, Device::Cpu);
                match recipe {
                    Recipe::Standard => {
                        let input = model.blend_input(&target);
                        for tensor in [
                            &input.candidates,
                            &input.prior,
                            &input.visibility,
                            &input.target,
                        ] {
                            assert_finite(&what, tensor);
                        }
                        if let Some(Composition::Blend(net, params)) = &model.composition {
                            assert_finite(&what, &no_grad(|| net.forward(params, &input)));
                        }
                    }
                    Recipe::Paper => assert_finite(&what, &model.paper_input(&target)),
                }
                if every {
                    let image = model.image(&target);
                    assert_image(&what, &image, &target);
                    assert_image(&what, &model.diffuse_image(&target), &target);
                    painted += i32::from(image.max().double_value(&[]) > 0.0);
                }
                let chosen = model.chosen(&target);
                assert_image(
                    &what,
                    &naive_ibr(&model.references, &target, &chosen),
                    &target,
                );
                assert_image(
                    &what,
                    &debevec_ibr(&model.references, &mesh, &target),
                    &target,
                );
                for surface in &surfaces {
                    assert_image(&what, &surface.image(&mesh, &target), &target);
                }
            }
        }
    }
    assert!(painted > 40, "only {painted} images show anything");
}

/// The largest difference of two images, of 255.
fn difference(a: &Tensor, b: &Tensor) -> f64 {
    (a - b).abs().max().double_value(&[]) * 255.0
}

#[test]
fn the_order_of_references_changes_no_pixel() {
    let mesh = hard::object(14, 20);
    tch::manual_seed(42);
    let images = &reference_sets()[0].1;
    let mut turned = images.clone();
    turned.rotate_left(2);
    turned.swap(0, 3);
    let [one, other] = [images, &turned].map(|images| model(&mesh, images, Recipe::Standard));
    for (view, camera) in hard::cameras() {
        let target = Target::new(&Drawable::new(&mesh), &camera, &one.settings, Device::Cpu);
        let names = |model: &Model, images: &[ReferenceImage]| -> Vec<Camera> {
            let chosen = model.chosen(&target);
            chosen.into_iter().map(|at| images[at].camera).collect()
        };
        assert_eq!(names(&one, images), names(&other, &turned), "{view}");
        for (mine, its) in [
            (
                naive_ibr(&one.references, &target, &one.chosen(&target)),
                naive_ibr(&other.references, &target, &other.chosen(&target)),
            ),
            (
                debevec_ibr(&one.references, &mesh, &target),
                debevec_ibr(&other.references, &mesh, &target),
            ),
        ] {
            // Sums in another order: roundings of f32.
            let difference = difference(&mine, &its);
            assert!(difference < 0.01, "{view}: {difference} of 255");
        }
    }
}

#[test]
fn damaged_meshes_render_within_bounds() {
    let images = &reference_sets()[0].1;
    for (what, mesh) in hard::damaged_meshes(8, 12) {
        let model = model(&mesh, images, Recipe::Standard);
        let surface = SurfaceColors::new(&mesh, &model.references, ColorGrid::Texels);
        for camera in [hard::ordinary(), hard::ring()[1]] {
            let target = Target::new(&Drawable::new(&mesh), &camera, &model.settings, Device::Cpu);
            assert_image(what, &model.image(&target), &target);
            assert_image(what, &surface.image(&mesh, &target), &target);
            assert_image(
                what,
                &debevec_ibr(&model.references, &mesh, &target),
                &target,
            );
        }
    }
}

#[test]
fn grazing_planes_render_within_bounds() {
    let mesh = hard::plane(4);
    let images: Vec<ReferenceImage> = [0.0, 60.0, 89.0, 89.9]
        .map(|degrees| reference("plane", hard::grazing(degrees, 1.5), hard::pattern))
        .to_vec();
    let model = model(&mesh, &images, Recipe::Standard);
    for degrees in [0.0, 45.0, 80.0, 89.0, 89.9] {
        let what = format!("{degrees} degrees");
        let camera = hard::grazing(degrees, 1.5);
        let target = Target::new(&Drawable::new(&mesh), &camera, &model.settings, Device::Cpu);
        assert_image(&what, &model.image(&target), &target);
        assert_image(
            &what,
            &debevec_ibr(&model.references, &mesh, &target),
            &target,
        );
        assert!(
            model.image(&target).max().double_value(&[]) > 0.0,
            "{what}: nothing to see"
        );
    }
}
