//! A flight log of many ticks under attack, for `nearl verify`: a policy of noise and random weights on a plant that is the model itself.
//!
//!     cargo run --release -p nearl-runtime --example recorded -- ROBOT.urdf TICKS FOLDER [SUB_STEPS [DT]]

#[path = "../tests/attack/mod.rs"]
mod attack;

use std::path::Path;
use std::time::{Duration, Instant};

use nearl_constraints::Model;

/// Every joint at half its speed and four fifths of its force, with a stored brake.
const LIMITS: &str = "position = { margin = 0.01 }\nvelocity = { scale = 0.5 }\nacceleration = { limit = 25.0 }\n\
     torque = { scale = 0.8 }\nbraking = \"stored\"";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, urdf, ticks, folder, rest @ ..] = &arguments[..] else {
        return Err("give a robot file, a number of ticks and a folder".into());
    };
    let sub_steps = rest.first().map_or(Ok(1), |text| text.parse())?;
    let dt = rest.get(1).map_or(Ok(0.001), |text| text.parse())?;
    let urdf = std::fs::read_to_string(urdf)?;
    let model = Model::from_urdf_text(&urdf)?;
    let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
    let attack = attack::Attack {
        start: (0..model.nq()).map(|i| 0.5 * (low[i].max(-2.0) + high[i].min(2.0))).collect(),
        urdf,
        constraints: LIMITS.into(),
        dt,
        sub_steps,
        policy_every: 20,
        seed: 1,
        ticks: ticks.parse()?,
        pause: Duration::ZERO,
    };
    let begin = Instant::now();
    let (log, summary) = attack.fly(Path::new(folder));
    println!(
        "{}: {} ticks in {:.0} s, {} in brief",
        log.display(),
        summary.written,
        begin.elapsed().as_secs_f64(),
        summary.brief
    );
    Ok(())
}
