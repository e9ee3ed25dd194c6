//! A carriage of 2 kg on a rail, driven by a force: a complete driver. Usage: `driver NAME TICKS`

use nearl_runtime::link::{Exchange, Robot, RobotName, STATE_RESET, Turn};

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let [_, name, ticks] = &std::env::args().collect::<Vec<_>>()[..] else {
        return Err("usage: driver NAME TICKS".into());
    };
    let [acted, braked, farthest, fastest] = drive(name, ticks.parse()?)?;
    println!("{acted} {braked} {farthest:.6} {fastest:.6}");
    Ok(())
}

/// Ticks acted and braked, and how far and how fast the carriage went [m, m/s].
pub(crate) fn drive(name: &str, ticks: u64) -> Result<[f64; 4], Failure> {
    let dt = 0.001;
    let robot = Robot { lockstep: true, ..Robot::new(&["slide"], &["q.slide", "v.slide"], 1, dt) };
    let mut plant = Exchange::open(&RobotName::new(name)?, &robot, 0.02)?;
    let (mut q, mut v, mut farthest, mut fastest) = (0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64); // the robot
    let (mut acted, mut braked, mut tick) = (0, 0, 0);
    while acted < ticks && braked < 100 {
        let state = plant.state();
        (state.time, state.bits) = (tick as f64 * dt, if tick == 0 { STATE_RESET } else { 0 });
        // 1. measure, 2. ask
        let force = match plant.exchange(&[q], &[v], &[q, v], 0.3) {
            Turn::Act(action) => (action[0], acted += 1).0,
            Turn::Hold(action) => action[0],
            Turn::Brake => (-2.0 * v / dt, braked += 1).0, // 3. brake by itself
        };
        v += dt * force.clamp(-40.0, 40.0) / 2.0; // 4. actuate
        q += dt * v;
        (farthest, fastest) = (farthest.max(q.abs()), fastest.max(v.abs()));
        tick += 1;
    }
    let found = [acted as f64, braked as f64, farthest, fastest];
    (acted == ticks).then_some(found).ok_or_else(|| "no loop came, or it left".into())
}
