//! Ray-traced demo captures with ground truth.
