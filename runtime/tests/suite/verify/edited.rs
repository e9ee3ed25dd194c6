//! Metadata, snapshots and files that were changed, made costly or damaged.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use nearl_constraints::description::{JointDescription, JointKind};
use nearl_runtime::Snapshot;
use nearl_runtime::cli::{UNVERIFIED, VerifyCommand, exit_code};
use nearl_verify::{Violation, verify};
use serde_json::{Value, json};

use super::{Alter, LIMITS, attack, copy, limits_in, record, with_limit};
use crate::arm::Scratch;
use crate::attack::Attack;
use crate::toy::Name;

/// What the metadata says of robot, period, rows and snapshot is what the snapshot in the log says.
#[test]
fn metadata_that_was_edited_or_emptied_is_named() {
    let folder = Scratch::new("verify-facts");
    let slow = Attack { pause: Duration::from_micros(300), ticks: 200, ..attack(LIMITS, 0.001, 1, 20) };
    let (log, _) = slow.record(&Name::new("verify-facts").0, &folder.0);
    let other = folder.0.join("copy.mcap");
    let with = |change: Alter<BTreeMap<String, String>>| {
        copy(&log, &other, &|_, _| true, &|bytes| bytes, &|facts| change(facts));
        verify(&other).unwrap()
    };
    assert_eq!(with(&|_| {}).found, 0);
    for (key, edited) in [
        ("dt", "0.002"),
        ("joints", "panda_joint2,panda_joint1"),
        ("rows", "[\"panda_joint1\"]"),
        ("statuses", "{\"0\":\"solved\"}"),
        ("modes", "[\"active\"]"),
        ("rungs", "brake"),
        ("digest", "0123456789abcdef"),
        ("version", "77"),
        ("task", "another"),
    ] {
        for value in [edited, ""] {
            let report = with(&|facts| {
                assert!(facts.insert(key.into(), value.into()).is_some(), "{key} is in every log");
            });
            let told = &report.violations[0];
            assert!(report.found == 1 && told.to_string().starts_with("metadata"), "{key}\n{report}");
            assert!(told.what.contains(&format!("`{key}`")) && !report.is_whole(), "{key}\n{report}");
        }
    }
    for key in ["dt", "joints", "rows", "statuses", "modes", "rungs"] {
        let report = with(&|facts| _ = facts.remove(key));
        assert!(report.found == 1 && report.to_string().contains(&format!("`{key}`")), "{key}\n{report}");
    }
    let refused = |change: Alter<BTreeMap<String, String>>| {
        copy(&log, &other, &|_, _| true, &|bytes| bytes, &|facts| change(facts));
        verify(&other).unwrap_err().to_string()
    };
    let text = refused(&|facts| _ = facts.insert("limits".into(), String::new()));
    assert!(text.contains("`limits` is damaged"), "{text}");
}

#[test]
fn a_limit_that_was_changed_in_the_log_is_found_out_looser_or_tighter() {
    let (folder, log) = record("verify-limits", &attack(LIMITS, 0.001, 1, 20));
    let other = folder.0.join("copy.mcap");
    for (section, key, values) in [
        ("velocity", "scale", [0.45, 0.55]),
        ("acceleration", "limit", [22.0, 28.0]),
        ("torque", "scale", [0.7, 0.9]),
        ("position", "margin", [1.5, 1.4]),
    ] {
        for value in values {
            let change = |constraints: &mut Value| constraints[section][key] = value.into();
            let facts = |facts: &mut _| limits_in(facts, &change);
            copy(&log, &other, &|_, _| true, &|bytes| with_limit(bytes, &change), &facts);
            let report = verify(&other).unwrap();
            assert!(report.found > 0, "{section}.{key} = {value}\n{report}");
        }
    }
    // What the loop pinned holds too, whatever its snapshot says.
    let slower = |limits: &mut Value| limits["velocity"]["scale"] = 0.3.into();
    let facts = |facts: &mut _| limits_in(facts, &slower);
    copy(&log, &other, &|_, _| true, &|bytes| bytes, &facts);
    assert!(verify(&other).unwrap().violations[0].what.contains("speed of joint"));
}

/// A log that is sound and made to cost much: it is refused or its ticks are not verified, by a reason, in bounded time.
#[test]
fn a_log_that_is_made_to_cost_much_ends_with_a_reason() {
    let (folder, log) = record("verify-hostile", &Attack { ticks: 200, ..attack(LIMITS, 0.001, 1, 20) });
    let other = folder.0.join("copy.mcap");
    let braked = |log: &Path, brake: &dyn Fn(f64) -> f64| {
        let edit = |topic: &str, m: &mut Value| {
            if topic == "tick" {
                let speeds = m["target_v"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap().abs());
                m["brake"] = json!(speeds.map(brake).collect::<Vec<_>>());
            }
            true
        };
        copy(log, &other, &edit, &|bytes| bytes, &|_| {});
        verify(&other).unwrap()
    };
    // Brakes of minutes in every tick.
    let report = braked(&log, &|_| 1e-3);
    assert!(report.found > 100 && report.to_string().contains("comes to rest"), "{report}");
    // Just short enough to be looked at, and nothing that they break: steps of work run out.
    let roomy = "velocity = { scale = 0.5 }\nacceleration = { limit = 25.0 }\ntorque = { scale = 1.0 }\nbraking = \"stored\"";
    let (_folder, slow) = record("verify-slow", &Attack { ticks: 150, ..attack(roomy, 0.001, 1, 20) });
    let report = braked(&slow, &|speed| (speed / 90.0).max(1e-9));
    println!("{report}");
    assert!(report.not_stopped.values().sum::<u64>() > 50, "{report}");
    assert!(report.to_string().contains("takes longer than a log of this length is given"), "{report}");
    // More joints than are verified, and one with several degrees of freedom.
    let refused = |change: &dyn Fn(&mut Snapshot), word: &str| {
        let changed = |bytes: Vec<u8>| {
            let mut snapshot = Snapshot::from_bytes(&bytes).unwrap();
            change(&mut snapshot);
            snapshot.to_bytes()
        };
        copy(&log, &other, &|_, _| true, &changed, &|_| {});
        let text = verify(&other).unwrap_err().to_string();
        assert!(text.contains(word), "{text}");
    };
    let many = |snapshot: &mut Snapshot| {
        let joints = (0..300).map(|k| JointDescription::new(&format!("more {k}"), JointKind::Hinge));
        snapshot.manifest.robot.bodies.last_mut().unwrap().joints.extend(joints);
    };
    refused(&many, "joints, more than the 256 that are verified");
    let ball = |snapshot: &mut Snapshot| {
        let joint = snapshot.manifest.robot.bodies.iter_mut().find_map(|body| body.joints.first_mut());
        joint.unwrap().kind = JointKind::Ball;
    };
    refused(&ball, "joint 'panda_joint1' has several degrees of freedom");
    let text = verify(&other).unwrap_err().to_string();
    assert!(text.contains("nearl replay") && !text.contains("of this build"), "{text}");
}

#[test]
fn what_a_log_does_not_have_is_not_verified_and_a_damaged_one_is_refused_by_name() {
    let (folder, log) = record("verify-gaps", &attack(LIMITS, 0.001, 1, 20));
    let other = folder.0.join("copy.mcap");
    let edit =
        |topic: &str, m: &mut Value| topic != "tick" || !(600..650).contains(&m["tick"].as_u64().unwrap());
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    let report = verify(&other).unwrap();
    assert_eq!((report.found, report.unverified(), report.is_whole()), (0, 50, false), "{report}");
    assert!(
        report.ticks == 1450 && report.to_string().contains("50 ticks, the log does not have them"),
        "{report}"
    );

    let refused = |what: &str| {
        let text = verify(&other).unwrap_err().to_string();
        assert!(text.contains(what) && text.contains("copy.mcap"), "{what}: {text}");
    };
    copy(&log, &other, &|_, _| true, &|bytes| bytes, &|facts| _ = facts.insert("schema".into(), "4".into()));
    refused(&format!("its schema is 4, this build reads {}", nearl_runtime::log::SCHEMA_VERSION));
    copy(&log, &other, &|topic, _| topic != "snapshot", &|bytes| bytes, &|_| {});
    refused("snapshot number 0 is not in it");
    copy(
        &log,
        &other,
        &|topic, m| {
            if topic == "snapshot" {
                m["digest"] = "00".into();
            }
            true
        },
        &|bytes| bytes,
        &|_| {},
    );
    refused("snapshot number 0 is not in it");
    copy(
        &log,
        &other,
        &|topic, m| {
            if topic == "tick" && m["tick"] == 9 {
                m["state"] = 3.into();
            }
            true
        },
        &|bytes| bytes,
        &|_| {},
    );
    refused("a message of topic `tick` is damaged");
    std::fs::write(&other, b"no log at all, but long enough for a header").unwrap();
    refused("");
    std::fs::write(&other, b"").unwrap();
    refused("it is empty");
    std::fs::remove_file(&other).unwrap();
    std::fs::create_dir(&other).unwrap();
    refused("it is not a regular file");

    let whole = std::fs::read(&log).unwrap();
    let cut = folder.0.join("cut.mcap");
    std::fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    let report = verify(&cut).unwrap();
    assert!(report.found == 0 && !report.complete && !report.is_whole() && report.verified > 100, "{report}");
    let ends: [&[u8]; 4] = [
        &whole[..whole.len() - 1],
        &whole[..whole.len() - 50],
        &[&whole[..], &whole[..]].concat(),
        &[&whole[..], b"more"].concat(),
    ];
    for other in ends {
        std::fs::write(&cut, other).unwrap();
        let report = verify(&cut).unwrap();
        assert!(report.found == 0 && report.complete && !report.intact && !report.is_whole(), "{report}");
        assert!(
            report.to_string().contains("the end of the file behind the last tick, which was cut off"),
            "{report}"
        );
        let failure = VerifyCommand { file: cut.clone(), json: true }.run().expect_err("not whole");
        assert_eq!(exit_code(&failure), UNVERIFIED);
        assert!(failure.to_string().contains("not all of it could be: the end of the file;"), "{failure}");
    }
    let violation = |what: &str, value: f64, unit: &str| {
        Violation { tick: 5, what: what.into(), value, limit: 2.0, unit: unit.into() }.to_string()
    };
    assert_eq!(violation("action[1]", f64::NAN, "a number"), "tick 5: action[1] is NaN, which is no number");
    assert_eq!(violation("row 're'", 2.5, ""), "tick 5: row 're' is 2.5, and 2 is what holds there");
}
