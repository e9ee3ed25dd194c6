//! A flight log of many ticks under attack, for `nearl verify`: a policy of noise and random weights on a plant that is the model itself.
//!
//!     cargo run --release -p nearl-runtime --example recorded -- ROBOT.urdf TICKS FOLDER [SUB_STEPS [DT [SEED [KIND]]]]
//!
//! | KIND | every joint at half its speed |
//! |---|---|
//! | `stored` | four fifths of its force and 25 rad/s², with a stored brake (the default) |
//! | `certified` | all of its force and 3 rad/s², each joint braking by itself |
//! | `moved` | as `stored`, limits moved every 0.3 s and back |
//! | `jerk` | as `stored`, with hard jerk |

#[path = "../tests/attack/mod.rs"]
mod attack;

use std::path::Path;
use std::time::{Duration, Instant};

use nearl_constraints::{Model, Moved};

const LIMITS: &str = "position = { margin = 0.01 }\nvelocity = { scale = 0.5 }\n";
const STORED: &str = "acceleration = { limit = 25.0 }\ntorque = { scale = 0.8 }\nbraking = \"stored\"";
/// What the motors of the arms can do everywhere.
const CERTIFIED: &str = "acceleration = { limit = 3.0 }\ntorque = { scale = 1.0 }\nbraking = \"certified\"";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, urdf, ticks, folder, rest @ ..] = &arguments[..] else {
        return Err("give a robot file, a number of ticks and a folder".into());
    };
    let sub_steps = rest.first().map_or(Ok(1), |text| text.parse())?;
    let dt: f64 = rest.get(1).map_or(Ok(0.001), |text| text.parse())?;
    let seed = rest.get(2).map_or(Ok(1), |text| text.parse())?;
    let kind = rest.get(3).map_or("stored", String::as_str);
    let own = match kind {
        "stored" | "moved" => STORED.to_owned(),
        "jerk" => format!("{STORED}\njerk = {{ limit = 600.0, hard = true }}"),
        "certified" => CERTIFIED.to_owned(),
        other => return Err(format!("'{other}' is none of stored, certified, moved, jerk").into()),
    };
    let (ticks, every) = (ticks.parse()?, (0.3 / dt) as u64);
    let orders = [0.3, 1.0, 0.1, 0.6, 1.0, 0.02, 1.0];
    let order = |k: u64| (k * every, Moved::speed(orders[k as usize % orders.len()]));
    let urdf = std::fs::read_to_string(urdf)?;
    let model = Model::from_urdf_text(&urdf)?;
    let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
    let attack = attack::Attack {
        start: (0..model.nq()).map(|i| 0.5 * (low[i].max(-2.0) + high[i].min(2.0))).collect(),
        urdf,
        constraints: format!("{LIMITS}{own}"),
        dt,
        sub_steps,
        plant_steps: 0,
        policy_every: 20,
        seed,
        ticks,
        moves: (1..if kind == "moved" { ticks / every } else { 0 }).map(order).collect(),
        pause: Duration::ZERO,
        lost: 0,
        late: 0,
        lag: 0.0,
        drive_damping: 0.0,
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
