//! `capture.toml`: what a capture says about itself.
//!
//! ```toml
//! object = "greek/vase-12"          # collection/object
//! title = "Painted vase"
//! licence = "CC BY 4.0"
//! rights = "The Museum"
//! proxy = "scan/mesh.ply"           # a file in the capture
//! reconstruction = "cameras.xml"    # a file in the capture, or a folder with a COLMAP model
//! masks = "white_is_object"         # or "white_is_background", "white_is_ignored", "black_is_ignored"
//! metres_per_scene_unit = 0.12
//! held_out = ["IMG_0007.jpg"]       # as test.txt
//! ```
//!
//! All keys are optional. An unknown key is an error: it is most likely a misspelt one.

use std::ops::Range;
use std::path::{Component, Path, PathBuf};

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::fault::Faults;

/// Name of the file in the capture folder.
pub(crate) const FILE_NAME: &str = "capture.toml";

const KEYS: &str =
    "object, title, licence, rights, proxy, reconstruction, masks, metres_per_scene_unit, held_out";

/// What the masks in files mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MaskMeaning {
    /// The rest is background.
    WhiteIsObject,
    /// The rest is the object.
    WhiteIsBackground,
    /// A hand, a stand: neither object nor background. The rest is either.
    WhiteIsIgnored,
    /// The rest may be either object or background.
    BlackIsIgnored,
}

/// The file's content; the default is what holds without the file.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Settings {
    pub(crate) object: Option<String>,
    pub(crate) title: Option<String>,
    pub(crate) licence: Option<String>,
    pub(crate) rights: Option<String>,
    pub(crate) proxy: Option<(PathBuf, usize)>,
    pub(crate) reconstruction: Option<(PathBuf, usize)>,
    pub(crate) masks: Option<MaskMeaning>,
    pub(crate) metres_per_scene_unit: Option<f64>,
    /// Names with their line.
    pub(crate) held_out: Option<Vec<(String, usize)>>,
}

/// Reads `dir/capture.toml` if it is there.
pub(crate) fn read(dir: &Path, faults: &mut Faults) -> Settings {
    let path = dir.join(FILE_NAME);
    if !path.exists() {
        return Settings::default();
    }
    match std::fs::read_to_string(&path) {
        Ok(text) => parse(&text, faults),
        Err(error) => {
            faults.error(
                format!("cannot read the file: {error}"),
                FILE_NAME,
                "it must be UTF-8 text",
            );
            Settings::default()
        }
    }
}

/// A path inside the capture: relative, and nowhere upwards.
pub(crate) fn is_inside(path: &Path) -> bool {
    let mut parts = path.components().peekable();
    parts.peek().is_some()
        && parts.all(|part| matches!(part, Component::Normal(_) | Component::CurDir))
}

fn parse(text: &str, faults: &mut Faults) -> Settings {
    let mut settings = Settings::default();
    let line_of =
        |span: Range<usize>| 1 + text.get(..span.start).unwrap_or(text).matches('\n').count();
    let at_line = |line: usize| format!("{FILE_NAME}:{line}");
    let table = match DeTable::parse(text) {
        Ok(table) => table.into_inner(),
        Err(error) => {
            let at = error
                .span()
                .map_or_else(|| FILE_NAME.into(), |span| at_line(line_of(span)));
            faults.error(
                error.message().trim_end_matches('.').to_lowercase(),
                at,
                "correct the TOML syntax",
            );
            return settings;
        }
    };
    for (key, value) in table {
        let key_line = line_of(key.span());
        let value_line = line_of(value.span());
        let mut wrong = |what: &str, hint: &str| {
            faults.error(
                format!("{} {what}", key.get_ref()),
                at_line(value_line),
                hint,
            );
        };
        let text_of = |value: &Spanned<DeValue<'_>>| value.get_ref().as_str().map(str::to_owned);
        match key.get_ref().as_ref() {
            name @ ("object" | "title" | "licence" | "rights") => {
                let Some(text) = text_of(&value) else {
                    wrong("must be a text", "put it between quotes");
                    continue;
                };
                match name {
                    "object" => settings.object = Some(text),
                    "title" => settings.title = Some(text),
                    "licence" => settings.licence = Some(text),
                    _ => settings.rights = Some(text),
                }
            }
            "proxy" => match text_of(&value).map(PathBuf::from) {
                Some(path) if is_inside(&path) => settings.proxy = Some((path, value_line)),
                _ => wrong(
                    "must be the path of a file inside the capture",
                    "for example proxy = \"mesh.ply\"",
                ),
            },
            "reconstruction" => match text_of(&value).map(PathBuf::from) {
                Some(path) if is_inside(&path) => {
                    settings.reconstruction = Some((path, value_line));
                }
                _ => wrong(
                    "must be the path of a file or folder inside the capture",
                    "for example reconstruction = \"cameras.xml\"",
                ),
            },
            "masks" => match text_of(&value).as_deref() {
                Some("white_is_object") => settings.masks = Some(MaskMeaning::WhiteIsObject),
                Some("white_is_background") => {
                    settings.masks = Some(MaskMeaning::WhiteIsBackground);
                }
                Some("white_is_ignored") => settings.masks = Some(MaskMeaning::WhiteIsIgnored),
                Some("black_is_ignored") => settings.masks = Some(MaskMeaning::BlackIsIgnored),
                _ => wrong(
                    "has an unknown meaning",
                    "use \"white_is_object\", \"white_is_background\", \"white_is_ignored\" or \"black_is_ignored\"",
                ),
            },
            "metres_per_scene_unit" => match scalar(value.get_ref()) {
                Some(metres) if metres.is_finite() && metres > 0.0 => {
                    settings.metres_per_scene_unit = Some(metres);
                }
                _ => wrong(
                    "must be a number above zero",
                    "for example 0.01 where one unit is a centimetre",
                ),
            },
            "held_out" => {
                let names = value.get_ref().as_array().and_then(|list| {
                    list.iter()
                        .map(|name| Some((text_of(name)?, line_of(name.span()))))
                        .collect::<Option<Vec<_>>>()
                });
                match names {
                    Some(names) => settings.held_out = Some(names),
                    None => wrong(
                        "must be a list of image names",
                        "for example held_out = [\"IMG_0007.jpg\"]",
                    ),
                }
            }
            other => faults.error(
                format!("unknown key {other:?}"),
                at_line(key_line),
                format!("known keys are {KEYS}"),
            ),
        }
    }
    settings
}

fn scalar(value: &DeValue<'_>) -> Option<f64> {
    match value {
        DeValue::Float(number) => number.as_str().replace('_', "").parse().ok(),
        DeValue::Integer(number) if number.radix() == 10 => {
            number.as_str().replace('_', "").parse().ok()
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places(text: &str) -> Vec<String> {
        let mut faults = Faults::default();
        parse(text, &mut faults);
        faults.into_list().into_iter().map(|f| f.at).collect()
    }

    #[test]
    fn every_key_is_read() {
        let text = "object = 'a/b'\ntitle = \"T\"\nlicence = 'L'\nrights = 'R'\nproxy = 'x/m.ply'\n\
                    masks = 'white_is_background'\nmetres_per_scene_unit = 1_0\nheld_out = ['1.png',\n'2.png']\n\
                    reconstruction = 'sparse/3'\n";
        let mut faults = Faults::default();
        let settings = parse(text, &mut faults);
        assert!(faults.into_list().is_empty());
        assert_eq!(
            settings,
            Settings {
                object: Some("a/b".into()),
                title: Some("T".into()),
                licence: Some("L".into()),
                rights: Some("R".into()),
                proxy: Some(("x/m.ply".into(), 5)),
                reconstruction: Some(("sparse/3".into(), 10)),
                masks: Some(MaskMeaning::WhiteIsBackground),
                metres_per_scene_unit: Some(10.0),
                held_out: Some(vec![("1.png".into(), 8), ("2.png".into(), 9)]),
            }
        );
    }

    #[test]
    fn all_faults_are_found_with_their_lines() {
        let text = "titel = 'T'\nobject = 7\nproxy = '../m.ply'\nmasks = 'black'\n\nmetres_per_scene_unit = -1\nheld_out = 'x'\n";
        let mut places = places(text);
        places.sort();
        assert_eq!(
            places,
            [
                "capture.toml:1",
                "capture.toml:2",
                "capture.toml:3",
                "capture.toml:4",
                "capture.toml:6",
                "capture.toml:7"
            ]
        );
        assert_eq!(self::places("title = 'T'\nobject =\n"), ["capture.toml:2"]);
    }

    #[test]
    fn paths_upwards_are_outside() {
        assert!(is_inside(Path::new("a/b.ply")) && is_inside(Path::new("./b.ply")));
        for outside in ["", "/etc/x", "../x", "a/../../x"] {
            assert!(!is_inside(Path::new(outside)), "{outside}");
        }
    }
}
