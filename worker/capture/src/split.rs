//! Which views are held out: `test.txt`, else `capture.toml`, else every eighth view along the camera path.
//!
//! The camera path is the order of names, with runs of digits compared as numbers.

use std::cmp::Ordering;

/// One view of this many is held out where the capture names none.
const EVERY: usize = 8;

/// The views, out of `count` in path order, that are held out by default. The first one is from the middle of the
/// first run, so that the ends of the path stay with the training views. With 3 to 7 views one is held out, with
/// fewer none.
pub(crate) fn every_eighth(count: usize) -> Vec<usize> {
    match count {
        0..3 => Vec::new(),
        3..EVERY => vec![count / 2],
        _ => (EVERY / 2..count).step_by(EVERY).collect(),
    }
}

/// Order of names along the camera path: runs of digits by value, the rest by bytes.
pub(crate) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut a_rest, mut b_rest) = (a.as_bytes(), b.as_bytes());
    while let (Some(&a_byte), Some(&b_byte)) = (a_rest.first(), b_rest.first()) {
        let order = if a_byte.is_ascii_digit() && b_byte.is_ascii_digit() {
            let a_digits = take_digits(&mut a_rest);
            let b_digits = take_digits(&mut b_rest);
            a_digits
                .len()
                .cmp(&b_digits.len())
                .then_with(|| a_digits.cmp(b_digits))
        } else {
            (a_rest, b_rest) = (&a_rest[1..], &b_rest[1..]);
            a_byte.cmp(&b_byte)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
    // Equal but for leading zeros: the bytes decide, so that the order is total.
    a_rest.len().cmp(&b_rest.len()).then_with(|| a.cmp(b))
}

/// Takes the digits at the front, without leading zeros.
fn take_digits<'a>(rest: &mut &'a [u8]) -> &'a [u8] {
    let length = rest.iter().take_while(|b| b.is_ascii_digit()).count();
    let (digits, behind) = rest.split_at(length);
    *rest = behind;
    let zeros = digits.iter().take_while(|&&b| b == b'0').count();
    &digits[zeros..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_compare_as_numbers() {
        let mut names = vec!["b1", "a10.png", "a9.png", "a09.png", "a", "a10x", "a2b3"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(
            names,
            ["a", "a2b3", "a09.png", "a9.png", "a10.png", "a10x", "b1"]
        );
    }

    #[test]
    fn default_split_leaves_the_ends_to_training() {
        assert!(every_eighth(2).is_empty());
        assert_eq!(every_eighth(5), [2]);
        assert_eq!(every_eighth(8), [4]);
        assert_eq!(every_eighth(26), [4, 12, 20]);
        for count in 3..100 {
            let held_out = every_eighth(count);
            assert!(!held_out.is_empty() && held_out.iter().all(|&i| i < count));
            assert!(count - held_out.len() >= 2, "{count}");
        }
    }
}
