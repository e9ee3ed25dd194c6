//! What must hold for every kind of limit in the registry.

use crate::common::*;
use nearl_constraints::limit::{Form, REGISTRY, RegisteredLimit};
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
    // Each kind by itself, without a stored brake.
    let settings = Settings { solver, braking: Braking::Certified, ..Settings::new(0.001, 1) };
    Projector::new(&model, &limits, &[0, 1, 2, 3, 4, 5, 6], settings).unwrap()
}

/// The example of a kind with one more setting, such as `("margin", 0.1)` or `("soft", table)`, in its first limit.
fn with_setting(entry: &RegisteredLimit, key: &str, value: impl Into<toml::Value>) -> String {
    let mut section: toml::Table = toml::from_str(entry.about.example).unwrap();
    let limit = match section.iter_mut().next().unwrap().1 {
        toml::Value::Array(limits) => &mut limits[0],
        limit => limit,
    };
    if let Some(robot) = limit.as_str() {
        *limit = toml::Table::from_iter([("robot".to_string(), robot.into())]).into();
    }
    limit.as_table_mut().unwrap().insert(key.to_string(), value.into());
    let (key, value) = section.into_iter().next().unwrap();
    format!("{key} = {value}")
}

fn softened(entry: &RegisteredLimit) -> String {
    let soft = toml::Table::from_iter([("linear".into(), 0.1.into()), ("quadratic".into(), 5.0.into())]);
    with_setting(entry, "soft", soft)
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
        let mut projector = projector(&settings_with(entry.about.example), Solver::Ladder);
        let (mut solved, mut braked) = (0, 0);
        walk(&mut projector, 4000, 3, |_, _, _, target| {
            assert!(target.q.iter().chain(&target.v).chain(&target.acceleration).all(|x| x.is_finite()));
            assert_eq!(target.ledger.target_violations.total(), 0, "{}: {:?}", entry.name, target.ledger);
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
                let own = |row: &&ActiveRow| row.kind == entry.kind;
                active += target.ledger.active.iter().filter(own).count();
            });
            active
        };
        let line = match entry.name {
            "torque" => "torque = { scale = 0.45 }",
            _ => entry.about.example,
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
fn every_kind_is_hard_or_soft_as_the_registry_says() {
    for entry in REGISTRY.iter().filter(|e| e.name != "locked") {
        let read = |line: &str| -> Result<Option<Soft>, String> {
            let section: ConstraintSettings = toml::from_str(line).map_err(|e| e.to_string())?;
            let limits = (entry.build)(&section);
            Ok(limits[0].soft())
        };
        let (plain, soft) = (read(entry.about.example).unwrap(), read(&softened(entry)));
        let given = Some(Soft { linear: 0.1, quadratic: 5.0 });
        match entry.about.form {
            Form::Hard => {
                let error = soft.expect_err(entry.name);
                assert!(plain.is_none() && error.contains("always hard"), "{}: {error}", entry.name);
            }
            Form::Soft => {
                assert_eq!((plain, soft.unwrap()), (Some(Soft::default()), given), "{}", entry.name)
            }
            Form::Either => assert_eq!((plain, soft.unwrap()), (None, given), "{}", entry.name),
        }
    }
}

/// A soft limit gives way to a pull stronger than its price and says by how much; it is no violation, and both solvers find the same.
#[test]
fn soft_kinds_give_way_and_say_so() {
    for entry in REGISTRY.iter().filter(|e| e.about.form == Form::Either) {
        let line = match entry.name {
            "torque" => "torque = { scale = 0.45, soft = { linear = 0.1, quadratic = 5.0 } }".to_string(),
            "torque_speed" => {
                "torque_speed = { stall = 40.0, no_load = 3.0, soft = { linear = 0.1, quadratic = 5.0 } }"
                    .to_string()
            }
            _ => softened(entry),
        };
        let constraints = settings_with(&line);
        let mut ladder = projector(&constraints, Solver::Ladder);
        let mut clarabel = projector(&constraints, Solver::Clarabel);
        let mut other = Target::new(ladder.model());
        let (mut gave, mut furthest) = (0, 0.0f64);
        walk(&mut ladder, 3000, 3, |q, v, raw, target| {
            assert_eq!(target.ledger.target_violations.total(), 0, "{}: {:?}", entry.name, target.ledger);
            assert!(target.ledger.status.is_ok(), "{}: {:?}", entry.name, target.ledger);
            gave += usize::from(target.ledger.active.iter().any(|row| row.slack > 0.0));
            clarabel.project(q, v, raw, &mut other);
            let apart = (0..7).fold(0.0f64, |most, i| most.max((other.v[i] - target.v[i]).abs()));
            furthest = furthest.max(apart);
        });
        println!("{:16} gave way in {gave} ticks, solvers {furthest:.1e} rad/s apart", entry.name);
        assert!(gave > 50, "{}: {gave}", entry.name);
        assert!(furthest < 1e-6, "{}: {furthest:e}", entry.name);
    }
}

/// A limit with a margin is the limit that is stricter by it.
#[test]
fn a_margin_is_kept_for_every_kind_with_a_bound() {
    let bare: Vec<&str> = REGISTRY.iter().filter(|e| e.about.stricter.is_none()).map(|e| e.name).collect();
    assert_eq!(bare, ["position", "locked"], "position is in projector.rs; what is locked has no bound");
    for (entry, [margin, strict]) in REGISTRY.iter().filter_map(|e| Some((e, e.about.stricter?))) {
        let name = entry.name;
        let mut with = projector(&settings_with(margin), Solver::Ladder);
        let mut without = projector(&settings_with(strict), Solver::Ladder);
        let (mut other, mut furthest, mut held) = (Target::new(with.model()), 0.0f64, 0);
        walk(&mut with, 2500, 3, |q, v, raw, target| {
            without.project(q, v, raw, &mut other);
            if without.needs_previous() {
                without.remember(target);
            }
            let own = |row: &&ActiveRow| row.kind == entry.kind;
            held += usize::from(target.ledger.active.iter().any(|row| own(&row)));
            furthest = (0..7).fold(furthest, |most, i| most.max((other.v[i] - target.v[i]).abs()));
        });
        println!("{name:16} {furthest:.1e} rad/s apart, {held} ticks at it");
        assert!(furthest < 1e-8 && held > 20, "{name}: {furthest:e} {held}");
    }
}

#[test]
fn both_solvers_agree_on_every_kind() {
    for entry in REGISTRY {
        let constraints = settings_with(entry.about.example);
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
        let constraints = settings_with(entry.about.example);
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
        (
            "velocity = { limit = 1.0, margin = 1.5 }",
            "velocity margin of joint 'panda_joint1' is 1.5, but must be at least 0 and below",
        ),
        ("energy = { limit = 1.0, margin = 1.0 }", "energy margin is 1, but must be at least 0 and below"),
        ("torque = { margin = { elbow = 1.0 } }", "torque margin names joint 'elbow'"),
        (
            "rows = [{ name = \"r\", terms = { \"v.panda_joint1\" = 1.0 }, equals = 0.0, margin = 0.1 }]",
            "row 'r' has equals and a margin, which leave nothing",
        ),
        ("jerk = { limit = { elbow = 1.0 } }", "jerk limit names joint 'elbow'"),
        (
            "collision = { shapes = [{ frame = \"panda_hand\", shape = { sphere = { radius = 0.1 } } }, { name = \"a\", shape = \"half_space\" }, \
             { name = \"a\", shape = \"half_space\" }], braking = 2.0 }",
            "two obstacles of collision are named 'a'",
        ),
        (
            "jerk = { limit = 1.0, soft = { quadratic = 1e13 } }",
            "soft.quadratic of limit 'jerk' is 10000000000000, but must be above 0 and at most 1e12",
        ),
        (
            "rows = [{ name = \"r\", terms = { \"q.panda_joint1\" = 2.0 }, upper = 1.0, braking = 3e6 }]",
            "braking of row 'r' is 3000000, but must be above 0, and at most a million times the largest coefficient",
        ),
        (
            "rows = [{ name = \"r\", terms = { \"v.panda_joint1\" = 1.0 }, upper = 1.0 }, { name = \"r\", terms = { \"v.panda_joint2\" = 1.0 }, \
             upper = 1.0 }]",
            "two rows are named 'r'",
        ),
        (
            "frame = [{ frame = \"panda_hand\", name = \"a\", half_space = { normal = [0, 0, 1], through = [0, 0, 1] }, braking = 1.0 }, \
             { frame = \"panda_link7\", name = \"a\", half_space = { normal = [0, 0, 1], through = [0, 0, 1] }, braking = 1.0 }]",
            "two limits of kind frame are named 'a'",
        ),
        (
            "rows = [{ name = \"r\", terms = { \"v.panda_joint1\" = 1.0 }, upper = inf }]",
            "upper of row 'r' is inf, but must be a finite number; change it",
        ),
        ("jerk = { limit = 1.0, soft = { quadratic = 0.0 } }", "soft.quadratic of limit 'jerk' is 0"),
        ("torque_speed = { stall = 0.0, no_load = 1.0 }", "torque_speed stall is 0"),
        ("torque_rate = { limit = inf }", "torque_rate limit is inf"),
        ("locked = [\"elbow\"]", "locked names joint 'elbow'"),
        ("locked = [\"panda_joint1\", \"panda_joint1\"]", "locked names joint 'panda_joint1' twice"),
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
