//! Snapshot, networks, controller, real-time loop and links.
