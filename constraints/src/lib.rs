//! Robot model, dynamics, limits and the projector.
