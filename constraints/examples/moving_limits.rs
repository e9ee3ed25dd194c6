//! Limits that move, under attack: counts the ticks that break the declared way to the new limits, and sets the time of that way beside the shortest
//! possible.
//!
//! `cargo run --release -p nearl-constraints --example moving_limits > table.csv`, see `results/moving_limits`.

#[path = "../tests/common/mod.rs"]
mod common;

use common::arms::{rail_arm, random_arm, small_arm};
use common::{Random, panda, robot};
use nearl_constraints::*;

const A: f64 = 10.0;
/// Time between two orders [s].
const EVERY: f64 = 0.6;

/// What is moved.
#[derive(Clone, Copy, PartialEq)]
enum What {
    /// Speeds of joints, with no limit on torque.
    Speed,
    /// The same with torque, and a stored brake.
    SpeedWithTorque,
    /// Positions of joints, with torque.
    PositionWithTorque,
    /// The speed of a frame, with torque.
    FrameSpeed,
    /// The energy, with torque.
    Energy,
    /// A plane, with torque.
    Frame,
}

const ALL: [(What, &str); 6] = [
    (What::Speed, "speed"),
    (What::SpeedWithTorque, "speed, torque"),
    (What::PositionWithTorque, "position, torque"),
    (What::FrameSpeed, "frame_speed, torque"),
    (What::Energy, "energy, torque"),
    (What::Frame, "frame, torque"),
];

struct Scene {
    model: Model,
    frame: &'static str,
    torque: f64,
}

impl Scene {
    fn limits(&self, what: What, x: f64) -> Vec<Box<dyn Limit>> {
        let mut limits: Vec<Box<dyn Limit>> = vec![
            Box::new(PositionLimit::default()),
            Box::new(VelocityLimit::default()),
            Box::new(AccelerationLimit::uniform(A)),
        ];
        if what != What::Speed {
            limits.push(Box::new(TorqueLimit::scaled(self.torque)));
        }
        match what {
            What::FrameSpeed => limits.push(Box::new(FrameSpeedLimit::of(self.frame, 1.0))),
            What::Energy => limits.push(Box::new(EnergyLimit::of(8.0))),
            What::Frame => {
                let through = [x + 0.3, 0.0, 0.0];
                limits.push(Box::new(FrameLimit::half_space(self.frame, [1.0, 0.0, 0.0], through, 3.0)));
            }
            _ => {}
        }
        limits
    }
}

/// What a run came to.
#[derive(Default)]
struct Seen {
    ticks: usize,
    outside: usize,
    on_the_way: usize,
    /// Ticks it took, and the fewest there are, for each order that the state was outside of.
    took: Vec<(f64, f64)>,
}

/// An order and what it asks for: speeds by joint, or the share of what a frame or the energy may have.
struct Order {
    moved: Moved,
    speed: Vec<f64>,
    least: f64,
    at: usize,
    open: bool,
}

/// What the state has of the one number that is moved: speed of the frame [m/s], energy [J], place along x [m].
fn value(what: What, kinematics: &mut Kinematics, frame: FrameId, q: &[f64], v: &[f64]) -> f64 {
    kinematics.update(q, v, &vec![0.0; v.len()]);
    let at = kinematics.point(frame, [0.0; 3]);
    match what {
        What::FrameSpeed => at.velocity.iter().map(|x| x * x).sum::<f64>().sqrt(),
        What::Energy => kinematics.kinetic_energy(q, v),
        _ => at.position[0],
    }
}

/// Fewest ticks after which every joint is below its speed: one after the other at `A`, without regard to torque.
fn fewest(v: &[f64], speed: &[f64], dt: f64) -> f64 {
    let ticks = v.iter().zip(speed).map(|(v, most)| ((v.abs() - most) / (A * dt) - 1e-9).ceil());
    ticks.fold(0.0, f64::max)
}

/// Ticks after which `limit` holds by the better of two brakes at `A`, without regard to torque: all joints at once, each as hard as it can, or
/// all in proportion. A way to compare with, not the shortest there is.
fn by_brakes(
    what: What,
    kinematics: &mut Kinematics,
    frame: FrameId,
    state: (&[f64], &[f64]),
    limit: f64,
    dt: f64,
) -> f64 {
    let fastest = state.1.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
    let mut best = f64::INFINITY;
    for together in [false, true] {
        let (mut q, mut v) = (state.0.to_vec(), state.1.to_vec());
        for tick in 0..2000 {
            if value(what, kinematics, frame, &q, &v) <= limit * (1.0 + 1e-9) {
                best = best.min(f64::from(tick));
                break;
            }
            for i in 0..v.len() {
                let step = if together { A * dt * state.1[i].abs() / fastest } else { A * dt };
                v[i] -= v[i].signum() * step.min(v[i].abs());
                q[i] += dt * v[i];
            }
        }
    }
    best
}

fn run(scene: &Scene, what: What, (dt, sub_steps): (f64, u32), ticks: usize, seed: u64) -> Seen {
    let model = &scene.model;
    let n = model.nv();
    let (low, high, top) =
        (model.lower_position_limit(), model.upper_position_limit(), model.velocity_limit());
    let middle: Vec<f64> = (0..n).map(|i| 0.5 * (low[i] + high[i])).collect();
    let frame = model.frame(scene.frame).unwrap();
    let mut kinematics = Kinematics::new(model);
    let x = value(What::Frame, &mut kinematics, frame, &middle, &vec![0.0; n]);
    let braking = if what == What::Speed { Braking::Certified } else { Braking::Stored };
    let settings = Settings { braking, ..Settings::new(dt, sub_steps) };
    let all: Vec<usize> = (0..n).collect();
    let mut projector = Projector::new(model, &scene.limits(what, x), &all, settings).unwrap();
    let (mut raw, mut target) = (Proposal::new(model), Target::new(model));
    let (mut q, mut v, mut side) = (middle, vec![0.0; n], vec![1.0; n]);
    let (mut random, mut seen) = (Random(seed), Seen::default());
    let mut order = Order { moved: Moved::default(), speed: top.to_vec(), least: 0.0, at: 0, open: false };
    let mut next = 0;
    for tick in 0..ticks {
        if tick == next {
            next = tick + (EVERY / dt) as usize;
            order = Order { moved: Moved::default(), speed: top.to_vec(), least: 0.0, at: tick, open: false };
            // Every other order is the way back to what was built, so that there is speed again to take off.
            if (tick as f64 * dt / EVERY) as usize % 2 == 1 {
                order.moved = draw(&mut order, scene, what, &q, &mut random);
                order.least = match what {
                    What::Speed | What::SpeedWithTorque => fewest(&v, &order.speed, dt),
                    What::FrameSpeed | What::Energy => {
                        let limit =
                            order.moved.frame_speed.get(scene.frame).copied().or(order.moved.energy).unwrap();
                        by_brakes(what, &mut kinematics, frame, (&q, &v), limit, dt)
                    }
                    _ => 0.0,
                };
                order.open = order.least > 0.0;
            }
            projector.move_limits(&order.moved).unwrap();
        }
        for i in 0..n {
            if random.next() < dt / 0.3 {
                side[i] = if random.next() < 0.5 { -1.0 } else { 1.0 };
            }
            let speed = 3.0 * side[i] * top[i];
            (raw.q[i], raw.v[i]) = (q[i] + dt * speed, speed);
        }
        let status = projector.project(&q, &v, &raw, &mut target);
        let named = !target.ledger.outside.is_empty();
        let expected = matches!(status, Status::Tightening | Status::Braked(BrakeReason::NoVerifiedBrake));
        let faster = (0..n).any(|i| target.v[i].abs() > order.speed[i].max(v[i].abs()) + 1e-9);
        let beyond = (0..n).any(|i| target.q[i] > high[i] + 1e-9 || target.q[i] < low[i] - 1e-9);
        let harder = (0..n).any(|i| (target.v[i] - v[i]).abs() > A * dt + 1e-9);
        let wrong =
            target.ledger.target_violations.total() > 0 || (named && !expected) || faster || beyond || harder;
        if wrong {
            let l = &target.ledger;
            let why = [faster, beyond, harder, named && !expected];
            eprintln!(
                "tick {tick}: {status:?}, faster, beyond, harder, otherwise named {why:?}, {:?} {:?}",
                l.target_violations, l.outside
            );
        }
        seen.outside += usize::from(wrong);
        seen.on_the_way += usize::from(named);
        seen.ticks += 1;
        (q, v) = (target.q.clone(), target.v.clone());
        let there = match what {
            What::Speed | What::SpeedWithTorque => {
                (0..n).all(|i| v[i].abs() <= order.speed[i] * (1.0 + 1e-9))
            }
            What::FrameSpeed => {
                let limit = order.moved.frame_speed.get(scene.frame).copied().unwrap_or(1.0);
                value(what, &mut kinematics, frame, &q, &v) <= limit * (1.0 + 1e-9)
            }
            What::Energy => {
                value(what, &mut kinematics, frame, &q, &v)
                    <= order.moved.energy.unwrap_or(8.0) * (1.0 + 1e-9)
            }
            _ => false,
        };
        if order.open && there {
            order.open = false;
            seen.took.push(((tick + 1 - order.at) as f64, order.least));
        }
    }
    seen
}

fn draw(order: &mut Order, scene: &Scene, what: What, q: &[f64], random: &mut Random) -> Moved {
    let model = &scene.model;
    let named = |value: f64| [(scene.frame.to_string(), value)].into();
    match what {
        What::Speed | What::SpeedWithTorque => {
            let share = random.between(0.05, 0.8);
            order.speed.iter_mut().for_each(|v| *v *= share);
            Moved::speed(share)
        }
        What::PositionWithTorque => {
            // Somewhere near each joint, in front of it or behind.
            let each = |sign: f64, random: &mut Random| {
                let near = |i: usize, random: &mut Random| q[i] + sign * random.between(-0.2, 0.6);
                let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
                (0..q.len()).map(|i| near(i, random).clamp(low[i] + 0.3, high[i] - 0.3)).collect::<Vec<_>>()
            };
            let upper = each(1.0, random);
            Moved { upper: Some(PerJoint::Each(upper)), ..Moved::default() }
        }
        What::FrameSpeed => Moved { frame_speed: named(random.between(0.05, 0.6)), ..Moved::default() },
        What::Energy => Moved { energy: Some(random.between(0.05, 4.0)), ..Moved::default() },
        What::Frame => Moved { frame: named(random.between(0.0, 0.5)), ..Moved::default() },
    }
}

fn main() {
    let seconds: f64 = std::env::args().nth(1).map_or(60.0, |s| s.parse().expect("seconds of each run"));
    let scenes = [
        ("small", Scene { model: small_arm(), frame: "tool", torque: 0.6 }),
        ("rail", Scene { model: rail_arm(), frame: "tool", torque: 0.9 }),
        ("random", Scene { model: random_arm(4, 5), frame: "tool", torque: 0.9 }),
        ("panda", Scene { model: panda(), frame: "panda_hand", torque: 1.0 }),
        ("xarm7", Scene { model: robot("xarm7/xarm7.urdf"), frame: "link7", torque: 0.9 }),
    ];
    println!(
        "moved,robot,dt [s],sub_steps,ticks,outside the declared way,on the way,orders,median took / least,largest took / least,median excess [ticks]"
    );
    for (what, kind) in ALL {
        for (name, scene) in &scenes {
            for (dt, sub_steps) in [(0.001, 1), (0.001, 0), (0.002, 5), (0.01, 1), (0.02, 0)] {
                let seen = run(scene, what, (dt, sub_steps), (seconds / dt) as usize, 11);
                let mut ratios: Vec<f64> = seen.took.iter().map(|(took, least)| took / least).collect();
                let mut more: Vec<f64> = seen.took.iter().map(|(took, least)| took - least).collect();
                ratios.sort_by(f64::total_cmp);
                more.sort_by(f64::total_cmp);
                let middle = |x: &[f64]| x.get(x.len() / 2).map_or(String::new(), |x| format!("{x:.3}"));
                let last = ratios.last().map_or(String::new(), |x| format!("{x:.3}"));
                let Seen { ticks, outside, on_the_way, .. } = seen;
                let (orders, median, excess) = (ratios.len(), middle(&ratios), middle(&more));
                println!(
                    "\"{kind}\",{name},{dt},{sub_steps},{ticks},{outside},{on_the_way},{orders},{median},{last},{excess}"
                );
            }
        }
    }
}
