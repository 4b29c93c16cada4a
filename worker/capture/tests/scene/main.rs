//! Captures on disk through the public interface: preflight and loading of views.

mod common;
mod formats;
mod hard;
mod loading;
mod photographs;
mod preflight;
mod proxy;
