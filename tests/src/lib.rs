//! What crosses crates: conformance, parity, determinism, allocation.
