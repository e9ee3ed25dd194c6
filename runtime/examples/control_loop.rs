//! Twenty lines of a robot's control loop: a snapshot file in, torques out.
//!
//! `cargo run --release --example control_loop -- examples/snapshots/panda-reach.safetensors`

use nearl_runtime::{Controller, Snapshot};
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::env::args()
        .nth(1)
        .ok_or("give a snapshot file, e.g. examples/snapshots/panda-reach.safetensors")?;
    let mut controller = Controller::new(&Snapshot::load(Path::new(&file))?)?;
    let (mut state, noise, mut out) = (controller.state(), controller.noise(), controller.output());
    state.obs[..7].copy_from_slice(&state.q); // this robot observes q, v, then its goal
    for tick in 0..1000 {
        // a driver would measure here; this robot is ideal and reaches every target
        let status = controller.update(&state, &noise, &mut out);
        if tick % 250 == 0 {
            println!(
                "tick {tick}: {status:?}, torque of joint 2 {:.2} N m, {} ns",
                out.action[1], out.duration_ns
            );
        }
        state.q.copy_from_slice(&out.next.q);
        state.v.copy_from_slice(&out.next.v);
        state.obs[..7].copy_from_slice(&state.q);
        state.obs[7..14].copy_from_slice(&state.v);
    }
    Ok(())
}
