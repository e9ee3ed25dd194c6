//! What must hold for every kind of limit in the registry.

mod common;

use common::*;
use nearl_constraints::limit::REGISTRY;
use nearl_constraints::*;

/// The example of one kind, on top of the limits of single joints.
fn settings_with(line: &str) -> ConstraintSettings {
    let base =
        ["position = {}", "velocity = { scale = 0.6 }", "acceleration = { limit = 10.0, braking = 4.0 }"];
    let key = |line: &str| line.split_once(" =").expect("key = value").0.to_string();
    let kept = base.iter().filter(|b| key(b) != key(line)).copied();
    let text: Vec<&str> = kept.chain([line]).collect();
    toml::from_str(&text.join("\n")).unwrap_or_else(|e| panic!("{line}: {e}"))
}

fn projector(constraints: &ConstraintSettings, solver: Solver) -> Projector {
    let model = panda();
    let limits = build_limits(constraints, &model).unwrap();
    let settings = Settings { solver, ..Settings::new(0.001, 1) };
    Projector::new(&model, &limits, &[0, 1, 2, 3, 4, 5, 6], settings).unwrap()
}

/// A closed loop of random proposals: the robot goes where the target says.
fn walk(
    projector: &mut Projector,
    ticks: usize,
    seed: u64,
    mut see: impl FnMut(&[f64], &[f64], &Proposal, &Target),
) {
    let mut random = Random(seed);
    let (mut q, mut v) = (vec![0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3], vec![0.0; 7]);
    let mut target = Target::new(projector.model());
    projector.forget();
    let mut wish = [0.0; 7];
    for tick in 0..ticks {
        if tick % 40 == 0 {
            wish = std::array::from_fn(|_| random.between(-3.0, 3.0));
        }
        let mut raw = proposal(projector, &q, &v, 0.3, &mut random);
        raw.v.iter_mut().zip(&wish).for_each(|(v, w)| *v += 0.01 * w);
        projector.project(&q, &v, &raw, &mut target);
        if projector.needs_previous() {
            projector.remember(&target);
        }
        see(&q, &v, &raw, &target);
        (q, v) = (target.q.clone(), target.v.clone());
    }
}

#[test]
fn every_kind_reads_its_example_and_stays_finite_and_inside() {
    for entry in REGISTRY {
        let mut projector = projector(&settings_with(entry.example), Solver::Ladder);
        let (mut solved, mut braked) = (0, 0);
        walk(&mut projector, 4000, 3, |_, _, _, target| {
            assert!(target.q.iter().chain(&target.v).chain(&target.acceleration).all(|x| x.is_finite()));
            assert_eq!(target.ledger.violations.total(), 0, "{}: {:?}", entry.name, target.ledger);
            solved += usize::from(target.ledger.status == Status::Solved);
            braked += usize::from(!target.ledger.status.is_ok());
        });
        println!("{:16} solved {solved:4} braked {braked}", entry.name);
        assert_eq!(braked, 0, "{}", entry.name);
    }
}

#[test]
fn every_kind_binds_somewhere_and_not_when_it_is_switched_off() {
    for entry in REGISTRY.iter().filter(|e| !matches!(e.name, "position" | "acceleration")) {
        let kinds = |projector: &mut Projector| {
            let mut active = 0;
            walk(projector, 4000, 3, |_, _, _, target| {
                let own = |row: &&ActiveRow| {
                    row.kind.name() == entry.name || (row.kind, entry.name) == (Kind::User, "rows")
                };
                active += target.ledger.active.iter().filter(own).count();
            });
            active
        };
        let line = match entry.name {
            "torque" => "torque = { scale = 0.45 }",
            _ => entry.example,
        };
        let mut projector = projector(&settings_with(line), Solver::Ladder);
        let label = projector.enabled().map(|(l, _)| l.to_string()).last().unwrap();
        let on = kinds(&mut projector);
        let label = if entry.name == "velocity" { "velocity".to_string() } else { label };
        projector.set_enabled(&label, false).unwrap();
        let off = kinds(&mut projector);
        projector.set_enabled(&label, true).unwrap();
        println!("{:16} active {on} rows, {off} when off", entry.name);
        assert!(on > 0 && off == 0, "{}: {on} {off}", entry.name);
        assert_eq!(kinds(&mut projector), on, "{}: switching on again gives the same", entry.name);
    }
}

#[test]
fn both_solvers_agree_on_every_kind() {
    for entry in REGISTRY {
        let constraints = settings_with(entry.example);
        let mut ladder = projector(&constraints, Solver::Ladder);
        let mut clarabel = projector(&constraints, Solver::Clarabel);
        let mut other = Target::new(ladder.model());
        let mut furthest = 0.0f64;
        walk(&mut ladder, 1500, 5, |q, v, raw, target| {
            clarabel.project(q, v, raw, &mut other);
            if clarabel.needs_previous() {
                clarabel.remember(target);
            }
            for i in 0..7 {
                furthest = furthest.max((other.v[i] - target.v[i]).abs());
            }
        });
        println!("{:16} furthest {furthest:.1e} rad/s", entry.name);
        assert!(furthest < 1e-6, "{}: {furthest:e}", entry.name);
    }
}

#[test]
fn projecting_twice_changes_nothing_for_every_kind() {
    for entry in REGISTRY {
        let constraints = settings_with(entry.example);
        let mut first = projector(&constraints, Solver::Ladder);
        let mut second = projector(&constraints, Solver::Ladder);
        let mut again = Target::new(first.model());
        if first.needs_previous() {
            continue; // soft: the slack's price moves a target again
        }
        walk(&mut first, 1500, 7, |q, v, _, target| {
            let raw = Proposal { q: target.q.clone(), v: target.v.clone() };
            second.project(q, v, &raw, &mut again);
            for i in 0..7 {
                assert!(
                    (again.v[i] - target.v[i]).abs() < 1e-11,
                    "{}: {} {}",
                    entry.name,
                    again.v[i],
                    target.v[i]
                );
            }
        });
    }
}

#[test]
fn impossible_numbers_are_refused_by_name() {
    let model = panda();
    for (line, expected) in [
        ("jerk = { limit = -1.0 }", "jerk limit is -1, but must be above 0 rad/s³ or m/s³; change it"),
        ("jerk = { limit = nan }", "jerk limit is NaN"),
        ("jerk = { limit = { elbow = 1.0 } }", "jerk limit names joint 'elbow'"),
        ("jerk = { limit = 1.0, soft = { quadratic = 0.0 } }", "soft.quadratic of limit 'jerk' is 0"),
        ("torque_speed = { stall = 0.0, no_load = 1.0 }", "torque_speed stall is 0"),
        ("torque_rate = { limit = inf }", "torque_rate limit is inf"),
        ("locked = [\"elbow\"]", "locked names joint 'elbow'"),
        ("rows = [{ name = \"r\", terms = { \"q.elbow\" = 1.0 }, upper = 1.0 }]", "rows names joint 'elbow'"),
        (
            "rows = [{ name = \"r\", terms = { \"x.panda_joint1\" = 1.0 }, upper = 1.0 }]",
            "write q.<joint>, v.<joint> or a.<joint>",
        ),
        (
            "rows = [{ name = \"r\", terms = { \"q.panda_joint1\" = 1.0 } }]",
            "row 'r' needs equals, or lower or upper or both",
        ),
        (
            "rows = [{ name = \"r\", terms = { \"q.panda_joint1\" = 1.0 }, lower = 2.0, upper = 1.0 }]",
            "row 'r' would have to stay above 2 and below 1",
        ),
        (
            "rows = [{ name = \"r\", terms = { \"v.panda_joint1\" = 1.0 }, upper = 1.0, braking = 1.0 }]",
            "row 'r' has braking but not only positions",
        ),
        (
            "velocity_profile = { panda_joint1 = { limit = 1.0, offset = -0.1, squared = 1.0, lower = -1.0, upper = 1.0 } }",
            "velocity_profile offset of joint 'panda_joint1' is -0.1",
        ),
    ] {
        let limits = build_limits(&settings_with(line), &model);
        let built =
            limits.and_then(|l| Projector::new(&model, &l, &[0, 1, 2, 3, 4, 5, 6], Settings::new(0.001, 1)));
        let error = built.err().unwrap_or_else(|| panic!("{line} was accepted")).to_string();
        assert!(error.contains(expected), "{line}: {error}");
    }
}

#[test]
fn the_page_about_limits_names_every_kind_with_its_example() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/LIMITS.md")).unwrap();
    for entry in REGISTRY {
        assert!(
            page.contains(&format!("| `{}` |", entry.example)),
            "docs/LIMITS.md lacks `{}`",
            entry.example
        );
    }
}
