//! A deterministic stream of damaged inputs.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

/// Longest input made: parsers of larger files do not differ.
const LONGEST: usize = 1 << 16;
/// Words that text formats find hard.
const WORDS: [&str; 18] = [
    "0",
    "-1",
    "1e308",
    "-1e308",
    "1e-308",
    "nan",
    "inf",
    "-inf",
    "4294967295",
    "4294967296",
    "18446744073709551615",
    "18446744073709551616",
    "9007199254740993",
    "",
    "\"",
    "\u{fffd}",
    "../x",
    "\n",
];

/// Makes damaged inputs, the same ones for the same seed.
pub struct Mutator {
    rng: Pcg64,
}

impl Mutator {
    /// A stream of its own for each seed.
    pub fn new(seed: u64) -> Self {
        Self {
            rng: Pcg64::seed_from_u64(seed),
        }
    }

    /// One of `seeds`, damaged once or a few times.
    ///
    /// # Panics
    /// When there are no seeds.
    pub fn mutated(&mut self, seeds: &[Vec<u8>]) -> Vec<u8> {
        let mut bytes = seeds[self.below(seeds.len())].clone();
        for _ in 0..=self.below(4) {
            let other = &seeds[self.below(seeds.len())];
            self.damage(&mut bytes, other);
        }
        bytes.truncate(LONGEST);
        bytes
    }

    fn damage(&mut self, bytes: &mut Vec<u8>, other: &[u8]) {
        if bytes.is_empty() {
            bytes.extend(other);
        }
        let at = self.below(bytes.len());
        match self.below(10) {
            0 => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte ^= 1 << self.rng.random_range(0..8);
                }
            }
            1 => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte = [0, 1, 0x7f, 0x80, 0xff][self.below(5)];
                }
            }
            2 => bytes.truncate(at),
            3 => {
                let (from, to) = self.range(other.len());
                bytes.splice(at..at, other[from..to].iter().copied());
            }
            4 => {
                let (from, to) = self.range(bytes.len());
                bytes.drain(from..to);
            }
            5 => {
                let (from, to) = self.range(bytes.len());
                let part = bytes[from..to].to_vec();
                for _ in 0..=self.below(8) {
                    bytes.splice(from..from, part.iter().copied());
                }
            }
            6 | 7 => self.number(bytes, at),
            _ => self.word(bytes, at),
        }
    }

    /// An extreme integer or float, of any width and byte order, over what was there.
    fn number(&mut self, bytes: &mut [u8], at: usize) {
        let integers = [
            0,
            1,
            u64::MAX,
            1 << 63,
            (1 << 63) - 1,
            0x7fff_ffff,
            0x8000_0000,
            0xffff,
            1 << 40,
        ];
        let floats = [
            f64::NAN,
            f64::INFINITY,
            -0.0,
            1e308,
            f64::MIN_POSITIVE,
            -1.0,
        ]
        .map(f64::to_bits);
        let value = match self.below(3) {
            0 => floats[self.below(floats.len())],
            1 => u64::from((f64::from_bits(floats[self.below(floats.len())]) as f32).to_bits()),
            _ => integers[self.below(integers.len())],
        };
        let width = 1 << self.below(4);
        let mut value = value.to_le_bytes()[..width].to_vec();
        if self.rng.random_bool(0.3) {
            value.reverse();
        }
        for (byte, value) in bytes[at..].iter_mut().zip(value) {
            *byte = value;
        }
    }

    /// Another word in place of the one at `at`.
    fn word(&mut self, bytes: &mut Vec<u8>, at: usize) {
        let ends = |byte: &u8| byte.is_ascii_whitespace() || b",:;\"'<>=[]{}/".contains(byte);
        let from = bytes[..at]
            .iter()
            .rposition(ends)
            .map_or(0, |place| place + 1);
        let to = bytes[at..]
            .iter()
            .position(ends)
            .map_or(bytes.len(), |place| at + place);
        let word = WORDS[self.below(WORDS.len())];
        bytes.splice(from..to.max(from), word.bytes());
    }

    fn below(&mut self, limit: usize) -> usize {
        self.rng.random_range(0..limit.max(1))
    }

    fn range(&mut self, length: usize) -> (usize, usize) {
        let from = self.below(length);
        (from, from + self.below(length - from + 1).min(256))
    }
}
