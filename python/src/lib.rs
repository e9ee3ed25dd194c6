//! The extension module `nearl._core`.
