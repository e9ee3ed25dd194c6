//! A Franka FR3 as the plant of a loop: torques at 1 kHz over the robot's own protocol, spoken by franka-rs.
//!
//!     cargo build --release --locked --manifest-path examples/franka/Cargo.toml
//!     nearl-franka 172.16.0.2 model > fr3.urdf           # what the robot says of itself, with its tool: the task's [model] urdf
//!     nearl-franka 172.16.0.2 drive arm                  # beside: nearl run policy.safetensors --plant arm
//!
//! The robot adds gravity to what it is sent, so the driver takes it off. It ends with Ctrl-C: the arm is braked, then handed back to the robot.
//!
//! | option of `drive` | is |
//! |---|---|
//! | `--braking A` | deceleration of its own brake [rad/s²], 10: what the task's `acceleration` gives to braking |
//! | `--watchdog S` | without a fresh action for so long it brakes [s], 0.02 |
//! | `--seconds S` | leaves after so long |
//! | `--simulated` | the other side is a simulator that waits for each command: so does the driver, and no real-time kernel is asked for |

mod brake;
mod urdf;

use brake::Brake;
use franka::{RealtimeConfig, Torques, motion_finished};
use nearl_runtime::link::{Exchange, Robot, RobotName, STATE_RESET, Turn};
use std::sync::{Arc, atomic::AtomicBool, atomic::Ordering};

type Failure = Box<dyn std::error::Error>;

const N: usize = 7;
const DT: f64 = 0.001;
/// Largest torques [N m] and change of torque [N m/s] that the robot takes; beyond them it stops with an error.
const LARGEST: [f64; N] = [87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0];
const RATE: [f64; N] = [1000.0; N];
/// In the axes of a base that stands upright [m/s²], as in the task's model.
const GRAVITY: [f64; 3] = [0.0, 0.0, -9.81];
const USAGE: &str = "usage: nearl-franka ROBOT model | nearl-franka ROBOT drive NAME [--braking A] [--watchdog S] [--seconds S] [--simulated]";

fn main() -> std::process::ExitCode {
    match command(&std::env::args().skip(1).collect::<Vec<_>>()) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("nearl-franka: {reason}");
            std::process::ExitCode::FAILURE
        }
    }
}

fn command(words: &[String]) -> Result<(), Failure> {
    let simulated = words.iter().any(|word| word == "--simulated");
    let kernel = if simulated { RealtimeConfig::Ignore } else { RealtimeConfig::Enforce };
    match &words.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        // no torque loop, so no real-time kernel is needed
        [address, "model"] => {
            println!("{}", urdf::with_tool(&franka::Robot::new(address, RealtimeConfig::Ignore)?)?)
        }
        [address, "drive", name, options @ ..] => {
            let settings = Settings::read(options)?;
            println!("{}", drive(&franka::Robot::new(address, kernel)?, name, &settings)?);
        }
        _ => return Err(USAGE.into()),
    }
    Ok(())
}

struct Settings {
    braking: f64,
    watchdog: f64,
    seconds: f64,
    simulated: bool,
}

impl Settings {
    fn read(options: &[&str]) -> Result<Settings, Failure> {
        let mut settings =
            Settings { braking: 10.0, watchdog: 0.02, seconds: f64::INFINITY, simulated: false };
        let mut left = options.iter();
        while let Some(&option) = left.next() {
            let place = match option {
                "--simulated" => {
                    settings.simulated = true;
                    continue;
                }
                "--braking" => &mut settings.braking,
                "--watchdog" => &mut settings.watchdog,
                "--seconds" => &mut settings.seconds,
                other => return Err(format!("'{other}' is no option; {USAGE}").into()),
            };
            let value = left.next().ok_or_else(|| format!("{option} needs a number"))?;
            *place = value
                .parse()
                .ok()
                .filter(|&x: &f64| x > 0.0)
                .ok_or_else(|| format!("{option} is '{value}'; give a number above 0"))?;
        }
        Ok(settings)
    }
}

/// What became of the ticks.
#[derive(Default)]
struct Report {
    acted: u64,
    held: u64,
    braked: u64,
    /// Ticks led by the loop in which not it but the robot's own limits on torque and its change decided what was sent.
    limited: u64,
}

impl std::fmt::Display for Report {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{{\"acted\": {}, \"held\": {}, \"braked\": {}, \"limited\": {}}}",
            self.acted, self.held, self.braked, self.limited
        )
    }
}

fn drive(robot: &franka::Robot, name: &str, settings: &Settings) -> Result<Report, Failure> {
    let model = robot.load_model()?;
    let joints = urdf::joints(robot)?;
    let described = Robot {
        observation: ["q", "v"]
            .iter()
            .flat_map(|x| joints.iter().map(move |joint| format!("{x}.{joint}")))
            .collect(),
        joints,
        limits: 0,
        stated: None,
        nq: N,
        nv: N,
        nu: N,
        dt: DT,
        lockstep: settings.simulated,
    };
    let mut plant = Exchange::open(&RobotName::new(name)?, &described, settings.watchdog)?;
    let leave = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, leave.clone())?;
    }

    let (mut report, mut brake) = (Report::default(), Brake::new(settings.braking));
    let (mut sent, mut time) = ([0.0; N], 0.0);
    let mut control = robot.start_torque_control()?;
    loop {
        let (measured, passed) = control.read_once()?; // 1. measure; this keeps the time, also of periods whose messages were lost
        time += passed.as_secs_f64();
        let leaving = leave.load(Ordering::Relaxed) || time >= settings.seconds;
        let state = plant.state();
        (state.time, state.bits) = (time, if time == 0.0 { STATE_RESET } else { 0 });
        let patience = match (settings.simulated, plant.is_attached()) {
            (false, _) => 0.6 * DT,
            (true, true) => 0.3,
            (true, false) => 0.002,
        };
        let (q, v) = (&measured.q, &measured.dq);
        let seen: [f64; 2 * N] = std::array::from_fn(|i| if i < N { q[i] } else { v[i - N] });
        let turn = if leaving { Turn::Brake } else { plant.exchange(q, v, &seen, patience) }; // 2. ask
        let leads = turn != Turn::Brake;
        let asked = match turn {
            Turn::Act(action) | Turn::Hold(action) => {
                *(if matches!(turn, Turn::Act(_)) { &mut report.acted } else { &mut report.held }) += 1;
                brake.release();
                let gravity = model.gravity_q(&measured.q, measured.m_total, &measured.F_x_Ctotal, &GRAVITY); // which the robot adds by itself
                std::array::from_fn(|i| action[i] - gravity[i])
            }
            Turn::Brake => {
                report.braked += 1;
                brake.torque(&model, &measured) // 3. brake by itself
            }
        };
        let within = std::array::from_fn(|i| asked[i].clamp(-LARGEST[i], LARGEST[i]));
        let torque = franka::limit_rate_torques(&RATE, &within, &sent)?;
        report.limited += u64::from(leads && torque != asked);
        sent = torque;
        if leaving && brake.stands() {
            control.write_once(&motion_finished(Torques::new(torque)))?;
            return Ok(report);
        }
        control.write_once(&Torques::new(torque))?; // 4. actuate
    }
}
