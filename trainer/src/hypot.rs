//! The length of a vector of two numbers without the C library.
//!
//! `f64::hypot` calls the C library's, which has a version of its own since glibc 2.35; nothing else asks for more than 2.34, which Debian 12,
//! RHEL 9 and the machines of many clusters have. What is linked with `--wrap=hypot` (the build scripts of `nearl` and the Python package)
//! calls this instead.

/// `sqrt(x² + y²)`, which neither overflows nor underflows on the way.
#[unsafe(no_mangle)]
extern "C" fn __wrap_hypot(x: f64, y: f64) -> f64 {
    libm::hypot(x, y)
}
