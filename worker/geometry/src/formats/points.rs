//! Points without faces.

use glam::DVec3;

use super::{Fault, ply};

/// The vertices of a PLY file, in its order, with 8-bit sRGB colours (black where the file has none). Faces are not
/// needed.
///
/// # Errors
/// What is wrong with the file and where, in words.
pub fn parse_points(bytes: &[u8]) -> Result<Vec<(DVec3, [u8; 3])>, String> {
    let soup = ply::parse(bytes).map_err(|Fault { at, reason }| format!("{reason} (at {at})"))?;
    let colors = soup.colors.unwrap_or_default();
    let colors = colors.into_iter().chain(std::iter::repeat([0; 3]));
    match soup.positions.iter().position(|point| !point.is_finite()) {
        Some(index) => Err(format!("point {index} has a position that is not finite")),
        None => Ok(soup.positions.into_iter().zip(colors).collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cloud_needs_no_faces() {
        let text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                    property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n\
                    1 2 3 255 0 9\n4 5 6 1 2 3\n";
        assert_eq!(
            parse_points(text.as_bytes()),
            Ok(vec![
                (DVec3::new(1.0, 2.0, 3.0), [255, 0, 9]),
                (DVec3::new(4.0, 5.0, 6.0), [1, 2, 3])
            ])
        );
        assert!(parse_points(text.replace("4 5 6", "4 nan 6").as_bytes()).is_err());
        assert!(parse_points(b"ply").is_err());
    }
}
