//! Hard cases of geometry: what each must come to is in the table of `tests/README.md`, whose rows name these tests.

#![expect(
    clippy::float_cmp,
    reason = "what must not change must not change by a bit"
)]

mod random;
mod selection;
mod surface;
mod warp;
