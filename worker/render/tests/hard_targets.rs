//! Target views and reference sets at the edge of what can be rendered: every image is finite, in range, and black
//! where the object is not. Finite is tested before the compositing, which would replace what is not.

use glam::{DAffine3, DVec3};
use ign_geometry::{Camera, CameraIntrinsics, Drawable, Mesh};
use ign_nets::Builder;
use ign_nets::composition::{BlendComposition, PaperComposition};
use ign_nets::effects::{PaperEffects, PointEffects};
use ign_render::{
    Composition, Effects, Model, Recipe, ReferenceImage, References, RenderSettings, Target,
    debevec_ibr, naive_ibr,
};
use tch::{Device, Tensor, no_grad};

const INTRINSICS: CameraIntrinsics = CameraIntrinsics {
    fx: 41.0,
    fy: 38.0,
    cx: 17.3,
    cy: 11.8,
    width: 36,
    height: 26,
};

/// A bumpy sphere, open at the top, with a sliver and a doubled triangle.
fn mesh() -> Mesh {
    let (rows, columns) = (20u32, 28u32);
    let mut positions = Vec::new();
    for row in 0..=rows {
        for column in 0..columns {
            let theta = std::f64::consts::PI * (0.15 + 0.85 * f64::from(row) / f64::from(rows));
            let phi = std::f64::consts::TAU * f64::from(column) / f64::from(columns);
            let radius = 0.8 + 0.12 * (3.0 * phi).sin() * theta.sin();
            let direction = DVec3::new(
                theta.sin() * phi.cos(),
                theta.sin() * phi.sin(),
                theta.cos(),
            );
            positions.push(direction * radius);
        }
    }
    let at = |r: u32, c: u32| r * columns + c % columns;
    let mut triangles: Vec<[u32; 3]> = (0..rows)
        .flat_map(|r| (0..columns).map(move |c| (r, c)))
        .flat_map(|(r, c)| {
            [
                [at(r, c), at(r + 1, c), at(r + 1, c + 1)],
                [at(r, c), at(r + 1, c + 1), at(r, c + 1)],
            ]
        })
        .collect();
    triangles.push(triangles[7]);
    triangles.push([0, rows * columns, 3]);
    Mesh::new(positions, triangles).expect("a mesh")
}

fn looking(eye: DVec3) -> Camera {
    let up = DVec3::new(0.05, 0.1, 1.0);
    Camera::look_at(INTRINSICS, eye, DVec3::new(0.02, -0.01, 0.03), up).expect("a camera")
}

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

fn pattern(at: usize, channel: usize) -> u8 {
    (at * 37 + channel * 91) as u8
}

fn targets() -> Vec<(&'static str, Camera)> {
    let near = looking(DVec3::new(2.2, 0.8, 0.6));
    let with = |change: &dyn Fn(&mut CameraIntrinsics)| {
        let mut intrinsics = INTRINSICS;
        change(&mut intrinsics);
        near.with_intrinsics(intrinsics)
    };
    let turned = DAffine3 {
        translation: near.camera_from_world.translation * DVec3::new(1.0, 1.0, -1.0),
        ..near.camera_from_world
    };
    vec![
        ("an ordinary view", near),
        (
            "from where no reference looks",
            looking(DVec3::new(-2.0, -1.0, -0.6)),
        ),
        ("into the opening", looking(DVec3::new(0.1, 0.1, 2.5))),
        ("from inside", looking(DVec3::new(0.1, -0.2, 0.15))),
        (
            "from within 1e-6 of the surface",
            looking(DVec3::new(0.0, 0.0, -0.800_001)),
        ),
        ("from 1e6 away", looking(DVec3::new(1e6, 3e5, 2e5))),
        (
            "with the object behind",
            Camera::new(INTRINSICS, turned).expect("a camera"),
        ),
        (
            "a reference's own pose but for 1e-6",
            looking(DVec3::new(2.3, 0.2 + 1e-6, 0.4)),
        ),
        (
            "a focal length of 1e-3 px",
            with(&|i| (i.fx, i.fy) = (1e-3, 1e-3)),
        ),
        (
            "a focal length of 1e7 px",
            with(&|i| (i.fx, i.fy) = (1e7, 1e7)),
        ),
        (
            "a principal point far outside",
            with(&|i| (i.cx, i.cy) = (-4e3, 9e3)),
        ),
        ("a principal point just outside", with(&|i| i.cx = -9.0)),
        ("one pixel", with(&|i| (i.width, i.height) = (1, 1))),
        ("one column", with(&|i| i.width = 1)),
    ]
}

fn reference_sets() -> Vec<(&'static str, Vec<ReferenceImage>)> {
    let ring: Vec<Camera> = [
        (2.3, 0.2, 0.4),
        (1.6, 1.6, 0.1),
        (1.9, -1.2, 0.9),
        (1.2, 0.3, 2.0),
        (2.4, 0.9, -0.8),
    ]
    .map(|(x, y, z)| looking(DVec3::new(x, y, z)))
    .to_vec();
    let all = |value: &dyn Fn(usize, usize) -> u8| {
        ring.iter()
            .map(|camera| reference("view", *camera, value))
            .collect::<Vec<_>>()
    };
    let blind = looking(DVec3::new(2.0, 0.0, 0.0));
    let blind = Camera {
        camera_from_world: DAffine3 {
            translation: DVec3::new(0.0, 0.0, -50.0),
            ..blind.camera_from_world
        },
        ..blind
    };
    let mut with_blind = all(&pattern);
    with_blind.push(reference("blind", blind, pattern));
    vec![
        ("five views", all(&pattern)),
        ("black pictures", all(&|_, _| 0)),
        ("white pictures", all(&|_, _| 255)),
        (
            "saturated in one channel",
            all(&|at, c| if c == 1 { 255 } else { pattern(at, c) }),
        ),
        ("a view that sees nothing", with_blind),
        ("one view", all(&pattern)[..1].to_vec()),
        (
            "the same view five times",
            vec![reference("copy", ring[0], pattern); 5],
        ),
    ]
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
            let net = PaperComposition::new(&mut second, settings.k);
            (
                Effects::Paper(effects, first.build(Device::Cpu, 1)),
                Composition::Paper(net, second.build(Device::Cpu, 2)),
            )
        }
        Recipe::Standard => {
            let effects = PointEffects::new(&mut first);
            let net = BlendComposition::new(&mut second, settings.k);
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
    let mesh = mesh();
    let proxy = Drawable::new(&mesh);
    tch::manual_seed(41);
    let mut painted = 0;
    for (set, images) in reference_sets() {
        for recipe in [Recipe::Standard, Recipe::Paper] {
            let model = model(&mesh, &images, recipe);
            // The paper's U-Nets take seconds for all sets; their input is what differs.
            let every = recipe == Recipe::Standard || set == "five views";
            for (view, camera) in targets() {
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
            }
        }
    }
    assert!(painted > 40, "only {painted} images show anything");
}
