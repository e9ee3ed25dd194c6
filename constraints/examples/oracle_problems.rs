//! Writes problems and our answers, for comparison with independent solvers: `results/oracles/compare.py`.
//!
//! `cargo run --release -p nearl-constraints --example oracle_problems -- COUNT FILE`
//!
//! For each robot a closed loop with rows (torque limits, a soft, an equal and a hard row of the user's own) and one with cones
//! (frame speed, kinetic energy, torque limits): states, proposals and targets of COUNT ticks in which a row or a cone held the
//! target back. One JSON object a line; nothing of our matrices is written.

#[path = "../src/random.rs"]
mod random;

use nearl_constraints::*;
use random::Random;
use serde_json::json;
use std::error::Error;
use std::io::Write;
use std::path::Path;

const DT: f64 = 1e-3;

/// Robot, share or value of the speed limit, acceleration limit [rad/s²], share of the motor forces, frame, its speed [m/s],
/// kinetic energy [J].
struct Case(&'static str, &'static str, f64, f64, &'static str, f64, f64);

const CASES: [Case; 7] = [
    Case("panda", "scale = 0.6", 40.0, 0.9, "panda_link7", 0.6, 1.5),
    Case("ur5", "scale = 0.6", 60.0, 0.9, "tool0", 0.8, 1.5),
    Case("xarm7", "scale = 0.6", 30.0, 1.0, "link7", 0.6, 1.5),
    Case("solo12", "limit = 15.0", 400.0, 0.002, "FL_FOOT", 1.5, 0.1),
    Case("anymal", "scale = 0.8", 300.0, 0.8, "LF_FOOT", 1.5, 2.0),
    Case("g1", "scale = 0.1", 200.0, 0.9, "left_wrist_yaw_link", 0.8, 1.0),
    Case("simple_humanoid", "scale = 0.5", 100.0, 0.9, "l_wrist", 0.5, 1.0),
];

/// The `[constraints]` section of a case.
fn constraints(case: &Case, model: &Model, cones: bool) -> String {
    let Case(_, speed, acceleration, torque, frame, frame_speed, energy) = case;
    let braking = 0.2 * acceleration;
    let mut text = format!(
        "position = {{}}\nvelocity = {{ {speed} }}\nacceleration = {{ limit = {acceleration:?}, braking = {braking:?} }}\ntorque = {{ scale = {torque:?} }}\n"
    );
    if cones {
        text += &format!("frame_speed = [{{ frame = \"{frame}\", limit = {frame_speed:?} }}]\n");
        return text + &format!("energy = {{ limit = {energy:?} }}\n");
    }
    let j = |k: usize| &model.joints()[k].name;
    text + &format!(
        "rows = [{{ name = \"soft\", terms = {{ \"v.{}\" = 1.0, \"v.{}\" = -0.5 }}, lower = -0.1, upper = 0.1, \
         soft = {{ linear = 0.3, quadratic = 20.0 }} }},\n\
         {{ name = \"equal\", terms = {{ \"v.{}\" = 1.0, \"v.{}\" = -0.5 }}, equals = 0.0 }},\n\
         {{ name = \"hard\", terms = {{ \"v.{}\" = 1.0, \"v.{}\" = 1.0 }}, upper = 0.25 }}]\n",
        j(0),
        j(1),
        j(2),
        j(3),
        j(4),
        j(5)
    )
}

/// Sizes of proposals, in largest velocity changes of one tick.
const SIZES: [f64; 5] = [3.0, 3.0, 30.0, 300.0, 3000.0];

/// Closed loop: the robot is where the target said.
fn run(case: &Case, cones: bool, count: usize, out: &mut impl Write) -> Result<String, Box<dyn Error>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../examples/robots/{0}/{0}.urdf", case.0));
    let model = Model::from_urdf(&path)?;
    let text = constraints(case, &model, cones);
    let settings: ConstraintSettings = toml::from_str(&text)?;
    let all: Vec<usize> = (0..model.nv()).collect();
    let mut projector =
        Projector::new(&model, &build_limits(&settings, &model)?, &all, Settings::new(DT, 1))?;
    let set = projector.limits().clone();
    let kind = if cones { "cones" } else { "rows" };
    let head = json!({ "robot": case.0, "kind": kind, "dt": DT, "joints": model.joints().iter().map(|j| &j.name).collect::<Vec<_>>(),
        "constraints": settings });
    writeln!(out, "{head}")?;
    let (mut random, mut target, mut raw) = (Random(7), Target::new(&model), Proposal::new(&model));
    let (mut q, mut v) = (vec![], vec![]);
    let (mut ticks, mut written, mut solved, mut braked, mut wish) = (0, 0, 0, 0, vec![0.0; model.nv()]);
    // How far proposals go, in largest changes of one tick: mostly what a policy asks for, sometimes what nobody should.
    let mut size = SIZES[0];
    while written < count && ticks < 400 * count {
        if ticks % 1000 == 0 {
            let place = |i: usize, r: &mut Random| {
                set.q_lower[i] + (set.q_upper[i] - set.q_lower[i]) * r.between(0.3, 0.7)
            };
            q = all.iter().map(|i| place(*i, &mut random)).collect();
            v = vec![0.0; model.nv()];
        }
        if ticks % 60 == 0 {
            wish.iter_mut().for_each(|w| *w = random.between(-1.5, 1.5));
            size = SIZES[(random.next() * SIZES.len() as f64) as usize];
        }
        for i in 0..model.nv() {
            let reach = set.acceleration[i] * DT;
            let step = (size / 3.0 * (wish[i] * set.velocity[i] - v[i])).clamp(-size * reach, size * reach);
            raw.v[i] = v[i] + step + reach * random.between(-1.0, 1.0);
            raw.q[i] = q[i] + DT * (raw.v[i] + size / 3.0 * reach * random.between(-1.0, 1.0));
        }
        let status = projector.project(&q, &v, &raw, &mut target);
        solved += usize::from(status == Status::Solved);
        braked += usize::from(!status.is_ok());
        if status == Status::Solved && random.next() < 0.2 {
            let kinds: Vec<&str> = target.ledger.active.iter().map(|r| r.kind.name()).collect();
            let rung = format!("{:?}", target.ledger.rung);
            let line = json!({ "q": q, "v": v, "q_hat": raw.q, "v_hat": raw.v, "answer": target.v, "active": kinds, "rung": rung });
            writeln!(out, "{line}")?;
            written += 1;
        }
        (q, v) = (target.q.clone(), target.v.clone());
        ticks += 1;
    }
    Ok(format!("{:16} {kind:5} {ticks} ticks, {solved} solved, {braked} braked, {written} written", case.0))
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut words = std::env::args().skip(1);
    let usage = "usage: oracle_problems COUNT FILE";
    let (count, file) = (words.next().ok_or(usage)?.parse()?, words.next().ok_or(usage)?);
    let mut out = std::io::BufWriter::new(std::fs::File::create(file)?);
    for case in &CASES {
        for cones in [false, true] {
            println!("{}", run(case, cones, count, &mut out)?);
        }
    }
    Ok(())
}
