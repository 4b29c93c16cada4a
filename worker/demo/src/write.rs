//! The capture's files.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use glam::DQuat;
use ign_geometry::Camera;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use rayon::prelude::*;

use crate::light::{Lighting, ShadePoint};
use crate::paint::{Paint, Place};
use crate::path::DemoView;
use crate::render::{Picture, encode};
use crate::shape::Surface;
use crate::trace::{Ray, Tracer};
use crate::{DemoError, DemoOptions};

/// Points of the sparse model, at least: every n-th vertex of the mesh.
const POINTS: usize = 1100;

/// A point is seen when nothing lies on the way to the eye, but for this part of it at the point.
const LEAVE: f64 = 1e-3;

pub(crate) fn folders(dir: &Path) -> Result<(), DemoError> {
    for name in [
        "images",
        "masks",
        "sparse/0",
        "truth/diffuse",
        "truth/depth",
    ] {
        let path = dir.join(name);
        fs::create_dir_all(&path).map_err(|source| DemoError::Io { path, source })?;
    }
    Ok(())
}

fn text(path: &Path, content: &str) -> Result<(), DemoError> {
    fs::write(path, content).map_err(|source| DemoError::Io {
        path: path.to_owned(),
        source,
    })
}

/// What all cameras see of each vertex, 8-bit sRGB: its colour without highlights.
pub(crate) fn vertex_colors(surface: &Surface, paint: &Paint, lighting: &Lighting) -> Vec<[u8; 3]> {
    let color = |vertex: usize| {
        let position = surface.positions[vertex] - surface.center;
        let (row, angle) = (surface.rows[vertex], position.y.atan2(position.x));
        let albedo = paint.albedo(Place {
            position,
            angle,
            inside: row > surface.rim_row,
        });
        encode(lighting.diffuse(&ShadePoint {
            position,
            normal: surface.normals[vertex],
            row,
            angle,
            albedo,
        }))
    };
    (0..surface.positions.len())
        .into_par_iter()
        .map(color)
        .collect()
}

/// `mesh.ply`, binary little endian, f32 positions and normals.
pub(crate) fn mesh(dir: &Path, surface: &Surface, colors: &[[u8; 3]]) -> Result<(), DemoError> {
    let path = dir.join("mesh.ply");
    let write = || -> io::Result<()> {
        let mut file = BufWriter::new(File::create(&path)?);
        write!(
            file,
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\n\
             property float x\nproperty float y\nproperty float z\n\
             property float nx\nproperty float ny\nproperty float nz\n\
             property uchar red\nproperty uchar green\nproperty uchar blue\n\
             element face {}\nproperty list uchar int vertex_indices\nend_header\n",
            surface.positions.len(),
            surface.triangles.len()
        )?;
        for ((position, normal), color) in
            surface.positions.iter().zip(&surface.normals).zip(colors)
        {
            for value in position.to_array().into_iter().chain(normal.to_array()) {
                file.write_all(&(value as f32).to_le_bytes())?;
            }
            file.write_all(color)?;
        }
        for triangle in &surface.triangles {
            file.write_all(&[3])?;
            for corner in triangle {
                file.write_all(&corner.to_le_bytes())?;
            }
        }
        file.flush()
    };
    write().map_err(|source| DemoError::Io {
        path: path.clone(),
        source,
    })
}

/// Indices of the sparse model's points among the vertices.
fn points(surface: &Surface) -> Vec<usize> {
    let vertices = surface.positions.len();
    (0..vertices).step_by((vertices / POINTS).max(1)).collect()
}

/// Per view, which of the sparse model's points it sees, and where.
pub(crate) fn observations(
    views: &[DemoView],
    surface: &Surface,
    tracer: &Tracer,
) -> Vec<Vec<Observation>> {
    let vertices = points(surface);
    views
        .par_iter()
        .map(|view| observe(view, surface, tracer, &vertices))
        .collect()
}

/// Number of a point of the sparse model, and its pixel.
type Observation = (usize, [f64; 2]);

/// The sparse model as text: one camera, all poses, and points with their tracks in the training views.
pub(crate) fn model(
    dir: &Path,
    (views, poses): (&[DemoView], &[Camera]),
    seen: &[Vec<Observation>],
    surface: &Surface,
    colors: &[[u8; 3]],
) -> Result<(), DemoError> {
    let sparse = dir.join("sparse/0");
    let vertices = points(surface);
    let mut cameras = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n");
    let mut images = String::from(
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n",
    );
    let mut tracks = vec![String::new(); vertices.len()];
    // Writing to a String does not fail; the results are passed on for form's sake.
    let fill =
        |cameras: &mut String, images: &mut String, tracks: &mut [String]| -> std::fmt::Result {
            if let Some(view) = views.first() {
                let i = &view.camera.intrinsics;
                writeln!(
                    cameras,
                    "1 PINHOLE {} {} {} {} {} {}",
                    i.width, i.height, i.fx, i.fy, i.cx, i.cy
                )?;
            }
            for (index, ((view, camera), seen)) in views.iter().zip(poses).zip(seen).enumerate() {
                let pose = camera.camera_from_world;
                let (q, t) = (DQuat::from_mat3(&pose.matrix3), pose.translation);
                let id = index + 1;
                writeln!(
                    images,
                    "{id} {} {} {} {} {} {} {} 1 {}.png",
                    q.w, q.x, q.y, q.z, t.x, t.y, t.z, view.stem
                )?;
                for (place, (point, px)) in seen.iter().enumerate() {
                    let gap = if place == 0 { "" } else { " " };
                    write!(images, "{gap}{} {} {}", px[0], px[1], point + 1)?;
                    write!(tracks[*point], " {id} {place}")?;
                }
                images.push('\n');
            }
            Ok(())
        };
    let failed = |_| DemoError::Io {
        path: sparse.clone(),
        source: io::Error::other("formatting failed"),
    };
    fill(&mut cameras, &mut images, &mut tracks).map_err(failed)?;

    let mut points =
        String::from("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n");
    for (point, track) in tracks
        .iter()
        .enumerate()
        .filter(|(_, track)| !track.is_empty())
    {
        let (p, [r, g, b]) = (surface.positions[vertices[point]], colors[vertices[point]]);
        writeln!(
            points,
            "{} {} {} {} {r} {g} {b} 0{track}",
            point + 1,
            p.x,
            p.y,
            p.z
        )
        .map_err(failed)?;
    }
    text(&sparse.join("cameras.txt"), &cameras)?;
    text(&sparse.join("images.txt"), &images)?;
    text(&sparse.join("points3D.txt"), &points)
}

/// The points that a training view sees, with their pixels; held-out views keep no observations.
fn observe(
    view: &DemoView,
    surface: &Surface,
    tracer: &Tracer,
    vertices: &[usize],
) -> Vec<Observation> {
    if view.held_out {
        return Vec::new();
    }
    let eye = view.camera.center();
    let mut seen = Vec::new();
    for (point, &vertex) in vertices.iter().enumerate() {
        let position = surface.positions[vertex];
        let Some(projection) = view.camera.project(position) else {
            continue;
        };
        let ray = Ray {
            origin: position,
            direction: eye - position,
            t_min: LEAVE,
            t_max: 1.0,
        };
        let faces = surface.normals[vertex].dot(ray.direction) > 0.0;
        if faces && view.camera.intrinsics.contains(projection.px) && !tracer.is_blocked(ray) {
            seen.push((point, projection.px.to_array()));
        }
    }
    seen
}

/// `test.txt` and `capture.toml`.
pub(crate) fn lists(
    dir: &Path,
    views: &[DemoView],
    options: &DemoOptions,
) -> Result<(), DemoError> {
    let held_out: Vec<String> = views
        .iter()
        .filter(|view| view.held_out)
        .map(|view| format!("{}.png\n", view.stem))
        .collect();
    if !held_out.is_empty() {
        text(&dir.join("test.txt"), &held_out.concat())?;
    }
    let shape = options.shape.name();
    let settings = format!(
        "# Rendered by `ign-worker demo-capture`: shape {shape}, gloss {}, seed {}.\n\
         object = \"demo/{shape}\"\ntitle = \"Painted {shape} (rendered)\"\nlicence = \"CC0-1.0\"\n\
         proxy = \"mesh.ply\"\nmasks = \"white_is_object\"\nmetres_per_scene_unit = 0.18\n",
        options.gloss, options.seed
    );
    text(&dir.join("capture.toml"), &settings)
}

/// Image and mask of a view; of held-out views the truth as well.
pub(crate) fn view(dir: &Path, view: &DemoView, picture: &Picture) -> Result<(), DemoError> {
    let name = format!("{}.png", view.stem);
    let size = (picture.width, picture.height);
    let (image, mask) = rayon::join(
        || {
            png(
                &dir.join("images").join(&name),
                &picture.image,
                size,
                ExtendedColorType::Rgb8,
            )
        },
        || {
            png(
                &dir.join("masks").join(&name),
                &picture.mask,
                size,
                ExtendedColorType::L8,
            )
        },
    );
    image.and(mask)?;
    if view.held_out {
        png(
            &dir.join("truth/diffuse").join(&name),
            &picture.diffuse,
            size,
            ExtendedColorType::Rgb8,
        )?;
        npy(
            &dir.join("truth/depth").join(format!("{}.npy", view.stem)),
            &picture.depth,
            size,
        )?;
    }
    Ok(())
}

fn png(
    path: &Path,
    data: &[u8],
    (width, height): (u32, u32),
    color: ExtendedColorType,
) -> Result<(), DemoError> {
    let file = File::create(path).map_err(|source| DemoError::Io {
        path: path.to_owned(),
        source,
    })?;
    PngEncoder::new_with_quality(
        BufWriter::new(file),
        CompressionType::Default,
        FilterType::Adaptive,
    )
    .write_image(data, width, height, color)
    .map_err(|source| DemoError::Image {
        path: path.to_owned(),
        source,
    })
}

/// The .npy format 1.0: f32, little endian, C order, shape (height, width).
fn npy(path: &Path, data: &[f32], (width, height): (u32, u32)) -> Result<(), DemoError> {
    let mut header =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}");
    // Magic, version and length take 10 bytes; the header ends with a newline at a multiple of 64.
    let padded = (10 + header.len() + 1).next_multiple_of(64) - 10;
    header = format!("{header:<width$}\n", width = padded - 1);
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend_from_slice(&(header.len() as u16).to_le_bytes());
    bytes.extend_from_slice(header.as_bytes());
    bytes.extend(data.iter().flat_map(|value| value.to_le_bytes()));
    fs::write(path, bytes).map_err(|source| DemoError::Io {
        path: path.to_owned(),
        source,
    })
}
