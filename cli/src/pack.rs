//! A capture folder as files with digests and one manifest: what `ignctl` uploads.
//!
//! The list of files is the capture contract of DESIGN section 5: `images/`, `sparse/`, `masks/`, `mesh.*`,
//! `test.txt`, `capture.toml`, another format's files of cameras with what they name, and another mesh only when it is
//! the proxy; with a glTF go the buffer files that it names. Faults of the content are not judged here: the worker's
//! preflight does that for every way a capture may come in.
//! Invariant: the manifest depends on paths and contents alone, so the same capture has the same digest on every
//! machine and is never stored or sent twice.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use futures::{StreamExt as _, TryStreamExt as _};
use ign_proto::{Digest, FileEntry, FilePath, Kind, Manifest};

use crate::memory::Checksums;
use crate::problem::{Doing as _, Problem, chain};

/// Folders taken whole.
const FOLDERS: [&str; 3] = ["images", "sparse", "masks"];
/// Files at the top that are always taken; beside them every `mesh.*`.
const FILES: [&str; 2] = ["capture.toml", "test.txt"];
/// Stands in for a capture without any file: a manifest names at least one, and the worker's preflight is to say
/// what is missing.
const NOTHING: &[u8] = b"# the submitted folder holds no file of a capture\n";

/// A file to be sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SourceFile {
    /// Path within the capture.
    pub(crate) path: FilePath,
    pub(crate) source: Source,
    pub(crate) size_bytes: u64,
}

/// Where a file's bytes are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    /// On this machine.
    File(PathBuf),
    /// The stand-in for a capture without files.
    Nothing,
}

impl Source {
    /// All bytes at once.
    pub(crate) async fn read(&self) -> Result<Vec<u8>, Problem> {
        match self {
            Self::File(file) => tokio::fs::read(file)
                .await
                .doing("cannot read", file.display()),
            Self::Nothing => Ok(NOTHING.to_vec()),
        }
    }
}

/// A file with its digest.
#[derive(Clone, Debug)]
pub(crate) struct PackedFile {
    pub(crate) file: SourceFile,
    pub(crate) digest: Digest,
}

/// A capture that is ready to be sent.
#[derive(Clone, Debug)]
pub(crate) struct Packed {
    pub(crate) files: Vec<PackedFile>,
    pub(crate) manifest: Vec<u8>,
    /// Digest of the manifest: the capture's name.
    pub(crate) digest: Digest,
}

/// The proxy's path within the capture when it is given apart from it.
pub(crate) fn proxy_path(proxy: &Path) -> Result<FilePath, Problem> {
    proxy_folder_path(Path::new(proxy.file_name().unwrap_or_default()))
}

fn proxy_folder_path(relative: &Path) -> Result<FilePath, Problem> {
    format!("proxy/{}", relative.to_string_lossy())
        .parse()
        .map_err(|error: ign_proto::IdError| {
            Problem::usage(error.to_string()).at(relative.display())
        })
}

/// The files that a glTF text names as its buffers, where they are there and beside it or below; nothing for any
/// other file. What is missing is the preflight's to report.
fn gltf_buffers(mesh: &Path) -> Vec<PathBuf> {
    #[derive(serde::Deserialize)]
    struct Document {
        #[serde(default)]
        buffers: Vec<Buffer>,
    }
    #[derive(serde::Deserialize)]
    struct Buffer {
        uri: Option<String>,
    }
    let is_gltf = mesh
        .extension()
        .is_some_and(|ending| ending.eq_ignore_ascii_case("gltf"));
    if !is_gltf {
        return Vec::new();
    }
    let document = std::fs::read(mesh)
        .ok()
        .and_then(|bytes| serde_json::from_slice::<Document>(&bytes).ok());
    let beside = mesh.parent().unwrap_or(Path::new(""));
    document
        .into_iter()
        .flat_map(|document| document.buffers)
        .filter_map(|buffer| buffer.uri)
        .filter(|uri| !uri.starts_with("data:"))
        .map(|uri| {
            let name = percent_encoding::percent_decode_str(&uri).decode_utf8_lossy();
            PathBuf::from(name.into_owned())
        })
        .filter(|path| stays_inside(path))
        .map(|path| beside.join(path))
        .filter(|path| path.is_file())
        .collect()
}

fn stays_inside(path: &Path) -> bool {
    path.components().all(|part| {
        matches!(
            part,
            std::path::Component::Normal(_) | std::path::Component::CurDir
        )
    })
}

/// Finds a proxy given on the command line: as it stands, or within the capture.
pub(crate) fn find_proxy(capture: &Path, proxy: &Path) -> Result<PathBuf, Problem> {
    [proxy.to_path_buf(), capture.join(proxy)]
        .into_iter()
        .find(|candidate| candidate.is_file())
        .ok_or_else(|| Problem::usage("the proxy does not exist").at(proxy.display()))
}

/// A path which is no folder is the user's mistake; a folder of any content is not.
pub(crate) fn check_folder(capture: &Path) -> Result<(), Problem> {
    match std::fs::metadata(capture) {
        Ok(meta) if meta.is_dir() => Ok(()),
        Ok(_) => Err(Problem::usage("a capture is a folder, this is a file").at(capture.display())),
        Err(error) => {
            Err(Problem::usage(format!("cannot open the capture: {error}")).at(capture.display()))
        }
    }
}

/// Whether a folder looks like a capture, for folders of captures.
pub(crate) fn looks_like_capture(dir: &Path) -> bool {
    ["images", "sparse"]
        .iter()
        .any(|name| dir.join(name).is_dir())
        || dir.join("capture.toml").is_file()
}

/// The capture's files, sorted by path.
pub(crate) fn list(capture: &Path, proxy: Option<&Path>) -> Result<Vec<SourceFile>, Problem> {
    check_folder(capture)?;
    let mut files = Vec::new();
    for folder in FOLDERS {
        let dir = capture.join(folder);
        if !dir.is_dir() {
            continue;
        }
        // Links are followed: large captures are often views on a photo archive.
        let walk = walkdir::WalkDir::new(&dir)
            .follow_links(true)
            .into_iter()
            .filter_entry(|entry| !is_hidden(entry.file_name()));
        for entry in walk {
            let entry = entry
                .map_err(|error| Problem::failed(format!("cannot read the capture: {error}")))?;
            if entry.file_type().is_file() {
                files.push(source_file(capture, entry.path())?);
            }
        }
    }
    let named_proxy = proxy_in_capture_toml(capture);
    for entry in std::fs::read_dir(capture).doing("cannot read the capture", capture.display())? {
        let path = entry
            .doing("cannot read the capture", capture.display())?
            .path();
        let name = path.file_name().unwrap_or_default();
        let mesh = path.file_stem().is_some_and(|stem| stem == "mesh");
        if (mesh || FILES.iter().any(|file| name == *file)) && path.is_file() {
            files.push(source_file(capture, &path)?);
            for buffer in gltf_buffers(&path) {
                files.push(source_file(capture, &buffer)?);
            }
        }
    }
    if let Some(named) = named_proxy {
        let path = capture.join(&named);
        if path.is_file() {
            files.push(source_file(capture, &path)?);
            for buffer in gltf_buffers(&path) {
                files.push(source_file(capture, &buffer)?);
            }
        }
    }
    for path in ign_capture::camera_files(capture) {
        files.push(source_file(capture, &capture.join(path))?);
    }
    if let Some(proxy) = proxy {
        let beside = proxy.parent().unwrap_or(Path::new(""));
        let mut send = |path: FilePath, source: &Path| -> Result<(), Problem> {
            files.push(SourceFile {
                path,
                source: Source::File(source.to_path_buf()),
                size_bytes: std::fs::metadata(source)
                    .doing("cannot read the proxy", source.display())?
                    .len(),
            });
            Ok(())
        };
        send(proxy_path(proxy)?, proxy)?;
        for buffer in gltf_buffers(proxy) {
            let relative = buffer.strip_prefix(beside).unwrap_or(&buffer);
            send(proxy_folder_path(relative)?, &buffer)?;
        }
    }
    files.sort_by(|a, b| a.path.cmp(&b.path));
    files.dedup_by(|a, b| a.path == b.path);
    if files.is_empty() {
        files.push(SourceFile {
            path: "capture.toml"
                .parse()
                .map_err(|error: ign_proto::IdError| Problem::failed(error.to_string()))?,
            source: Source::Nothing,
            size_bytes: NOTHING.len() as u64,
        });
    }
    Ok(files)
}

fn is_hidden(name: &std::ffi::OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b".")
}

fn source_file(capture: &Path, path: &Path) -> Result<SourceFile, Problem> {
    let unusable = |what: String| {
        Problem::failed(what)
            .at(path.display())
            .hint("rename the file")
    };
    let relative = path
        .strip_prefix(capture)
        .map_err(|error| unusable(error.to_string()))?;
    let names: Option<Vec<&str>> = relative.iter().map(|name| name.to_str()).collect();
    let names = names.ok_or_else(|| unusable("a file name is not UTF-8".to_string()))?;
    Ok(SourceFile {
        path: names
            .join("/")
            .parse()
            .map_err(|error: ign_proto::IdError| unusable(error.to_string()))?,
        source: Source::File(path.to_path_buf()),
        size_bytes: std::fs::metadata(path)
            .doing("cannot read", path.display())?
            .len(),
    })
}

/// The proxy that `capture.toml` names, if it stays within the capture. A broken file is the preflight's to report.
fn proxy_in_capture_toml(capture: &Path) -> Option<PathBuf> {
    let info = capture_toml(capture)?;
    let named = PathBuf::from(info.get("proxy")?.as_str()?);
    stays_inside(&named).then_some(named)
}

/// `capture.toml` as a table; none when it is absent or broken.
pub(crate) fn capture_toml(capture: &Path) -> Option<toml::Table> {
    std::fs::read_to_string(capture.join("capture.toml"))
        .ok()?
        .parse()
        .ok()
}

/// Hashes the files, as many at a time as there are cores, and writes the manifest; `hashed` hears of the bytes. Files that
/// an earlier run has read and that are unchanged since are not read again.
pub(crate) async fn pack(
    files: Vec<SourceFile>,
    hashed: impl Fn(u64) + Clone + Send + 'static,
) -> Result<Packed, Problem> {
    let at_once = std::thread::available_parallelism().map_or(2, usize::from);
    let checksums = Arc::new(Checksums::default());
    let files: Vec<PackedFile> = futures::stream::iter(files)
        .map(|file| {
            let (hashed, checksums) = (hashed.clone(), checksums.clone());
            async move {
                tokio::task::spawn_blocking(move || hash_file(file, &checksums, &hashed))
                    .await
                    .map_err(|error| Problem::failed(format!("hashing stopped: {error}")))?
            }
        })
        .buffered(at_once)
        .try_collect()
        .await?;
    let manifest = manifest(&files)?;
    let digest = Digest::of(&manifest);
    Ok(Packed {
        files,
        manifest,
        digest,
    })
}

fn hash_file(
    mut file: SourceFile,
    checksums: &Checksums,
    hashed: &impl Fn(u64),
) -> Result<PackedFile, Problem> {
    let Source::File(source) = &file.source else {
        return Ok(PackedFile {
            digest: Digest::of(NOTHING),
            file,
        });
    };
    let at = source.display().to_string();
    let read = checksums
        .of(source, None, hashed)
        .doing("cannot read", &at)?;
    let digest = read
        .sha256()
        .ok_or_else(|| Problem::failed("the file has no checksum").at(&at))?;
    // What was hashed counts, should the file have grown since it was listed.
    file.size_bytes = read.size_bytes;
    Ok(PackedFile { file, digest })
}

fn manifest(files: &[PackedFile]) -> Result<Vec<u8>, Problem> {
    let entries = files
        .iter()
        .map(|packed| FileEntry {
            path: packed.file.path.clone(),
            digest: packed.digest.clone(),
            size_bytes: packed.file.size_bytes,
            media_type: media_type(packed.file.path.as_str()).to_string(),
        })
        .collect();
    Manifest::new(Kind::Capture, entries, std::collections::BTreeMap::new())
        .and_then(|manifest| manifest.encode())
        .map_err(|error| Problem::failed(chain(&error)))
}

fn media_type(path: &str) -> &'static str {
    let extension = path.rsplit_once('.').map_or("", |(_, extension)| extension);
    match extension.to_ascii_lowercase().as_str() {
        "jpg" | "jpeg" => "image/jpeg",
        "png" => "image/png",
        "webp" => "image/webp",
        "glb" => "model/gltf-binary",
        "gltf" => "model/gltf+json",
        "obj" => "model/obj",
        "stl" => "model/stl",
        "txt" => "text/plain",
        "toml" => "application/toml",
        "json" => "application/json",
        "xml" => "application/xml",
        "csv" => "text/csv",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn capture() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for (path, text) in [
            ("images/b.jpg", "b"),
            ("images/.DS_Store", "x"),
            ("images/sub/a.png", "a"),
            ("sparse/0/cameras.txt", "c"),
            ("masks/b.png", "m"),
            ("depth/b.npy", "d"),
            ("mesh.ply", "mesh"),
            ("mesh.mtl", "material"),
            ("proxy_coarse.ply", "coarse"),
            ("test.txt", "b.jpg"),
            ("train.txt", ""),
            ("README.md", ""),
        ] {
            let path = dir.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        dir
    }

    fn paths(files: &[SourceFile]) -> Vec<&str> {
        files.iter().map(|file| file.path.as_str()).collect()
    }

    #[test]
    fn takes_what_the_contract_names_and_nothing_else() {
        let dir = capture();
        assert_eq!(
            paths(&list(dir.path(), None).unwrap()),
            [
                "images/b.jpg",
                "images/sub/a.png",
                "masks/b.png",
                "mesh.mtl",
                "mesh.ply",
                "sparse/0/cameras.txt",
                "test.txt"
            ]
        );
    }

    #[test]
    fn another_mesh_comes_along_only_as_the_proxy() {
        let dir = capture();
        let proxy = find_proxy(dir.path(), Path::new("proxy_coarse.ply")).unwrap();
        let files = list(dir.path(), Some(&proxy)).unwrap();
        assert!(paths(&files).contains(&"proxy/proxy_coarse.ply"));
        std::fs::write(
            dir.path().join("capture.toml"),
            "proxy = \"proxy_coarse.ply\"\n",
        )
        .unwrap();
        let files = list(dir.path(), None).unwrap();
        assert!(paths(&files).contains(&"proxy_coarse.ply"));
        std::fs::write(
            dir.path().join("capture.toml"),
            "proxy = \"../secret.ply\"\n",
        )
        .unwrap();
        assert!(
            !list(dir.path(), None)
                .unwrap()
                .iter()
                .any(|file| file.path.as_str().contains("secret"))
        );
        let missing = find_proxy(dir.path(), Path::new("none.ply")).unwrap_err();
        assert_eq!(missing.exit, crate::problem::Exit::Usage);
    }

    #[test]
    fn files_of_cameras_come_along_by_what_is_in_them() {
        let dir = capture();
        let write = |path: &str, text: &str| {
            let path = dir.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        let before = list(dir.path(), None).unwrap();
        write("inventory.csv", "object,price\nvase,100\n");
        write("notes.json", "{\"a\": 1}");
        write("notes.xml", "<html/>");
        assert_eq!(list(dir.path(), None).unwrap(), before);
        write("scan.csv", "#name,x,y,alt,heading,pitch,roll,f\n");
        write("bundle/bundle.out", "# Bundle file v0.3\n0 0\n");
        write("list.txt", "");
        write(
            "transforms.json",
            "{\"ply_file_path\": \"points.ply\", \"frames\": []}",
        );
        write("points.ply", "ply");
        write("other/images.bin", "");
        write("capture.toml", "reconstruction = \"other\"\n");
        let files = list(dir.path(), None).unwrap();
        let added: Vec<&str> = paths(&files)
            .into_iter()
            .filter(|path| !paths(&before).contains(path))
            .collect();
        assert_eq!(
            added,
            [
                "bundle/bundle.out",
                "capture.toml",
                "list.txt",
                "other/images.bin",
                "points.ply",
                "scan.csv",
                "transforms.json"
            ]
        );
    }

    #[test]
    fn buffers_of_a_gltf_go_with_it_and_nothing_outside() {
        let dir = capture();
        let text = r#"{"buffers":[{"uri":"my%20mesh.bin"},{"uri":"data:;base64,AA=="},{"uri":"../secret"},{"uri":"none"}]}"#;
        for folder in ["", "scan"] {
            let folder = dir.path().join(folder);
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join("mesh.gltf"), text).unwrap();
            std::fs::write(folder.join("my mesh.bin"), "b").unwrap();
        }
        let files = list(dir.path(), Some(&dir.path().join("scan/mesh.gltf"))).unwrap();
        let found = paths(&files);
        for path in [
            "mesh.gltf",
            "my mesh.bin",
            "proxy/mesh.gltf",
            "proxy/my mesh.bin",
        ] {
            assert!(found.contains(&path), "{path}: {found:?}");
        }
        assert!(
            !found
                .iter()
                .any(|path| path.contains("secret") || path.contains("none"))
        );
    }

    #[test]
    fn a_missing_folder_is_a_usage_error_and_an_empty_one_is_not() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(list(dir.path(), None).unwrap()[0].source, Source::Nothing);
        let missing = list(&dir.path().join("none"), None).unwrap_err();
        assert_eq!(missing.exit, crate::problem::Exit::Usage);
        let file = dir.path().join("file");
        std::fs::write(&file, "").unwrap();
        assert_eq!(
            list(&file, None).unwrap_err().exit,
            crate::problem::Exit::Usage
        );
    }

    #[tokio::test]
    async fn the_manifest_depends_on_contents_alone() {
        let (first, second) = (capture(), capture());
        let pack_dir = async |dir: &Path| pack(list(dir, None).unwrap(), |_| ()).await.unwrap();
        let packed = pack_dir(first.path()).await;
        assert_eq!(packed.digest, pack_dir(second.path()).await.digest);
        std::fs::write(second.path().join("test.txt"), "c.jpg").unwrap();
        assert_ne!(packed.digest, pack_dir(second.path()).await.digest);
        let manifest = Manifest::decode(&packed.manifest).unwrap();
        let first = &manifest.files()[0];
        assert_eq!(
            (first.path.as_str(), first.media_type.as_str()),
            ("images/b.jpg", "image/jpeg")
        );
        assert_eq!((&first.digest, first.size_bytes), (&Digest::of(b"b"), 1));
    }
}
