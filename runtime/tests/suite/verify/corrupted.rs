//! Ticks that were changed are named, each by what is wrong with it.

use nearl_verify::verify;
use serde_json::{Value, json};

use super::{LIMITS, add, attack, copy, first, holds, record, ticks};

/// What is done to the message of one tick.
type Edit = Box<dyn Fn(&mut Value)>;

/// A tick in the middle in which rows of torque and of joints are active, and its joint of each.
fn busy(all: &[Value]) -> (u64, usize, usize) {
    let has = |tick: &Value, from: u64, to: u64| {
        let rows = tick["ledger"]["active_rows"].as_array().unwrap();
        let strong = |row: &&Value| {
            (from..to).contains(&row["row"].as_u64().unwrap()) && row["multiplier"].as_f64().unwrap() > 1e-3
        };
        rows.iter().find(strong).map(|row| row["row"].as_u64().unwrap() as usize)
    };
    let found = all.iter().find_map(|tick| {
        let (joint, torque) = (has(tick, 0, 7)?, has(tick, 7, 14)?);
        let number = tick["tick"].as_u64().unwrap();
        (number > 400 && tick["ledger"]["status"] == 2).then_some((number, joint, torque - 7))
    });
    found.expect("a tick in which a joint and a motor are at their limits")
}

#[test]
fn every_seeded_corruption_is_named_at_its_tick() {
    let (folder, log) = record("verify-edited", &attack(LIMITS, 0.001, 1, 20));
    let (at, joint, _) = busy(&ticks(&log));
    let other = folder.0.join("copy.mcap");
    let found = |change: &dyn Fn(&mut Value)| {
        let edit = |topic: &str, value: &mut Value| {
            if topic == "tick" && value["tick"] == at {
                change(value);
            }
            true
        };
        copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
        verify(&other).unwrap()
    };
    assert_eq!(found(&|_| {}).found, 0);
    let cases: Vec<(&str, &str, Edit)> = vec![
        ("target_q", "position", Box::new(move |m: &mut Value| add(&mut m["target_q"][joint], 1e-7))),
        ("target_v", "joint", Box::new(move |m: &mut Value| add(&mut m["target_v"][joint], 1e-5))),
        ("action", "action for joint", Box::new(move |m: &mut Value| add(&mut m["action"][3], 1e-3))),
        (
            "action sign",
            "action for joint",
            Box::new(move |m: &mut Value| m["action"][1] = (-m["action"][1].as_f64().unwrap()).into()),
        ),
        ("state q", "joint", Box::new(move |m: &mut Value| add(&mut m["state"]["q"][1], 1e-4))),
        ("state v", "joint", Box::new(move |m: &mut Value| add(&mut m["state"]["v"][1], 1e-4))),
        (
            "multiplier",
            "no active row balances",
            Box::new(move |m: &mut Value| add(&mut m["ledger"]["active_rows"][0]["multiplier"], 1e-4)),
        ),
        (
            "multiplier below zero",
            "multiplier",
            Box::new(move |m: &mut Value| m["ledger"]["active_rows"][0]["multiplier"] = (-1.0).into()),
        ),
        (
            "row left out",
            "no active row balances",
            Box::new(move |m: &mut Value| {
                m["ledger"]["active_rows"].as_array_mut().unwrap().remove(0);
                m["ledger"]["active"] = (m["ledger"]["active"].as_u64().unwrap() - 1).into();
            }),
        ),
        (
            "row of another motor",
            "row",
            Box::new(move |m: &mut Value| {
                let k = first(m, 7);
                let row = m["ledger"]["active_rows"][k]["row"].as_u64().unwrap();
                m["ledger"]["active_rows"][k]["row"] = (7 + (row - 6) % 7).into();
            }),
        ),
        (
            "side of a row",
            "",
            Box::new(move |m: &mut Value| {
                let k = first(m, 7);
                let side = if m["ledger"]["active_rows"][k]["side"] == "upper" { "lower" } else { "upper" };
                m["ledger"]["active_rows"][k]["side"] = side.into();
            }),
        ),
        (
            "kind of a row",
            "number of the active",
            Box::new(move |m: &mut Value| {
                let k = first(m, 7);
                m["ledger"]["active_rows"][k]["kind"] = "frame".into();
            }),
        ),
        (
            "slack of a row",
            "slack",
            Box::new(move |m: &mut Value| m["ledger"]["active_rows"][0]["slack"] = 0.1.into()),
        ),
        (
            "rows gone",
            "ledger.active is",
            Box::new(move |m: &mut Value| m["ledger"]["active_rows"] = json!([])),
        ),
        (
            "said to be unchanged",
            "said to be unchanged",
            Box::new(move |m: &mut Value| m["ledger"]["status"] = 0.into()),
        ),
        (
            "said to be clamped",
            "said to be clamped joint by joint",
            Box::new(move |m: &mut Value| m["ledger"]["status"] = 1.into()),
        ),
        (
            "said to be unchanged, and no row",
            "no active row balances",
            Box::new(move |m: &mut Value| {
                m["ledger"]["status"] = 0.into();
                m["ledger"]["active"] = 0.into();
                m["ledger"]["active_rows"] = json!([]);
            }),
        ),
        ("slack", "ledger.slack", Box::new(move |m: &mut Value| m["ledger"]["slack"] = 0.9.into())),
        ("slack below", "ledger.slack", Box::new(move |m: &mut Value| m["ledger"]["slack"] = (-0.9).into())),
        ("outside", "ledger.outside", Box::new(move |m: &mut Value| m["ledger"]["outside"] = 1.into())),
        ("moved", "moved", Box::new(move |m: &mut Value| add(&mut m["ledger"]["moved"], 0.1))),
        ("status", "status", Box::new(move |m: &mut Value| m["ledger"]["status"] = 77.into())),
        ("recovering", "recovering", Box::new(move |m: &mut Value| m["ledger"]["status"] = 3.into())),
        (
            "violations",
            "target_violations",
            Box::new(move |m: &mut Value| m["ledger"]["target_violations"] = 3.into()),
        ),
        ("brake left out", "stored decelerations", Box::new(move |m: &mut Value| m["brake"] = json!([]))),
        (
            "brake beyond the motors",
            "stored deceleration",
            Box::new(move |m: &mut Value| m["brake"][0] = 25.1.into()),
        ),
        ("brake too weak", "way to stop", Box::new(move |m: &mut Value| m["brake"] = json!(vec![2e-2; 7]))),
        ("not a number", "target_v[2]", Box::new(move |m: &mut Value| m["target_v"][2] = Value::Null)),
        ("left out", "action", Box::new(move |m: &mut Value| m["action"] = json!([]))),
        (
            "a number too many",
            "length of action",
            Box::new(move |m: &mut Value| m["action"].as_array_mut().unwrap().push(json!(0.0))),
        ),
        ("cut", "length of target_q", Box::new(move |m: &mut Value| m["target_q"] = json!([0.0]))),
        ("speeds cut", "length of target_v", Box::new(move |m: &mut Value| m["target_v"] = json!([0.0]))),
        ("state cut", "length of state.v", Box::new(move |m: &mut Value| m["state"]["v"] = json!([0.0]))),
    ];
    for (name, word, change) in &cases {
        let report = found(&**change);
        let told: Vec<String> = report.violations.iter().map(ToString::to_string).collect();
        println!("{name}: {}", told.first().map_or("", String::as_str));
        assert!(report.found > 0, "{name} was not seen\n{report}");
        let is_named = |v: &String| v.starts_with(&format!("tick {at}: ")) && v.contains(word);
        assert!(told.iter().any(is_named), "{name}: {told:?}");
    }
    // A proposal is that of the tick in which the policy ran, for all of its period.
    let all = ticks(&log);
    let started =
        all.iter().rfind(|m| m["tick"].as_u64().unwrap() <= at && m["period_tick"] == 0).unwrap()["tick"]
            .clone();
    let edit = |topic: &str, value: &mut Value| {
        if topic == "tick" && value["tick"] == started {
            add(&mut value["proposal_v"][joint], 1e-3);
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    assert!(verify(&other).unwrap().found > 0, "a proposal was changed");
}

/// A record that is full may have fewer rows than were active; any other has them all.
#[test]
fn a_record_has_room_for_as_many_rows_as_the_loop_writes() {
    assert_eq!(nearl_verify::ROOM, nearl_runtime::rt::MAX_ROWS);
}

/// What a change cannot be seen in: nothing of it is claimed by the projection, or it says less than before.
#[test]
fn what_cannot_be_seen_is_what_is_written_in_the_page() {
    let (folder, log) = record("verify-unseen", &attack(LIMITS, 0.001, 1, 20));
    let (at, ..) = busy(&ticks(&log));
    let other = folder.0.join("copy.mcap");
    let edit = |topic: &str, m: &mut Value| {
        if topic == "tick" && m["tick"] == at {
            for time in ["due_ns", "begin_ns", "end_ns", "overruns", "stale", "lost_states", "policy_version"]
            {
                m[time] = (m[time].as_u64().unwrap() + 1).into();
            }
            m["reason"] = "stale-state".into();
            m["state"]["obs"][0] = 9.0.into();
            m["state"]["applied"][0] = 9.0.into();
            m["ledger"]["residual"] = 1.0.into();
            m["ledger"]["iterations"] = 99.into();
            m["ledger"]["duration_ns"] = 1.into();
            m["ledger"]["raw_violations"] = 40.into();
            m["log_prob_proposal"] = 3.0.into();
            m["noise"] = 1.0.into();
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    holds(&verify(&other).unwrap(), 1500);
    // A tick that says less is not found out, and is not counted as more than it says.
    let edit = |topic: &str, m: &mut Value| {
        if topic == "tick" && m["tick"] == at {
            m["ledger"]["status"] = 4.into();
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    let (before, after) = (verify(&log).unwrap(), verify(&other).unwrap());
    assert_eq!((after.found, after.optimal), (0, before.optimal - 1), "{after}");
}
