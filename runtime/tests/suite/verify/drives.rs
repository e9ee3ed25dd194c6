//! Targets of drives.

use nearl_verify::{Violation, verify};
use serde_json::Value;

use super::{LIMITS, attack, copy, holds, ticks};
use crate::arm::Scratch;
use crate::attack::Attack;

/// Targets are kept within the range of their drives. Where nothing keeps them, as under a soft torque limit, a drive that is sent less far than its
/// target asks for leads elsewhere: the log claims a target that nothing leads to.
#[test]
fn targets_of_drives_that_are_cut_at_their_range_are_found() {
    let drives = format!("{LIMITS}\n[command]\ninterface = \"pd\"\nstiffness = 100.0\ndamping = 5.0");
    let soft = drives.replace("torque = { scale = 0.8 }", "torque = { scale = 0.8, soft = {} }");
    for sub_steps in [1, 0] {
        let fly = |limits: &str, far: f64| {
            let attack = attack(limits, 0.001, sub_steps, 20);
            let (mut snapshot, model) = (attack.snapshot(1), attack.model());
            let reach = |i: usize| (model.effort_limit()[i] + 5.0 * model.velocity_limit()[i]) / 100.0 + 0.01;
            let ends = |of: &[f64], far: f64| (0..7).map(|i| of[i] + far * reach(i)).collect::<Vec<_>>();
            snapshot.manifest.action_lower = ends(model.lower_position_limit(), -far);
            snapshot.manifest.action_upper = ends(model.upper_position_limit(), far);
            let folder = Scratch::new(&format!("verify-cut-{sub_steps}-{far}-{}", limits.len()));
            let (log, summary) = attack.fly_with(&snapshot, &folder.0);
            assert_eq!((summary.dropped, summary.brief, summary.error), (0, 0, None));
            let at_end = ticks(&log).into_iter().filter(|tick| {
                let action = (0..7).map(|i| tick["action"][i].as_f64().unwrap());
                let range = snapshot.manifest.action_lower.iter().zip(&snapshot.manifest.action_upper);
                action.zip(range).any(|(x, (low, high))| (x - low).min(high - x) < 1e-6)
            });
            (verify(&log).unwrap(), at_end.count())
        };
        holds(&fly(&drives, 1.0).0, 1500);
        let (report, at_end) = fly(&drives, 0.0);
        println!("{sub_steps}: {report}, {at_end} ticks at an end");
        holds(&report, 1500);
        assert!(sub_steps == 0 || at_end > 0, "no target came to its end");
        let (mut found, mut told) = (false, false);
        for limit in ["limit = 25.0", "limit = 60.0", "limit = 100.0"] {
            let (report, at_end) = fly(&soft.replace("limit = 25.0", limit), 0.0);
            println!("{sub_steps}, {limit}: {report}, {at_end} ticks at an end");
            let is_cut = |violation: &Violation| violation.what.contains("is cut at its range");
            found |= report.found > 0 && report.violations.iter().any(is_cut);
            told |= report.not_verified.keys().any(|why| why.contains("is cut at its range"));
            assert_eq!(report.verified + report.found + report.unverified() + report.idle, 1500, "{report}");
        }
        assert!(found && told, "{found} {told}");
    }
}

/// Targets that are held over the steps of a period lead through them to what the log claims, and those that are another's do not; whether the steps
/// take the damping of the drives implicitly or not. Stiff drives come to their largest force at the ends of periods.
#[test]
fn targets_of_drives_are_verified_over_several_steps() {
    let cases = [
        (2, 0.002, 0.0, 100.0),
        (5, 0.005, 0.0, 100.0),
        (1, 0.002, 5.0, 100.0),
        (5, 0.005, 5.0, 100.0),
        (2, 0.002, 0.0, 4000.0),
        (5, 0.005, 5.0, 2000.0),
    ];
    for (sub_steps, dt, drive_damping, stiffness) in cases {
        let drives =
            format!("{LIMITS}\n[command]\ninterface = \"pd\"\nstiffness = {stiffness:?}\ndamping = 5.0")
                .replace("25.0", "8.0")
                .replace("scale = 0.8", if stiffness > 1000.0 { "scale = 0.5" } else { "scale = 0.8" });
        let flight = Attack { drive_damping, ..attack(&drives, dt, sub_steps, 20) };
        let mut snapshot = flight.snapshot(1);
        (snapshot.manifest.action_lower, snapshot.manifest.action_upper) = (vec![-9.0; 7], vec![9.0; 7]);
        let folder = Scratch::new(&format!("verify-targets-{sub_steps}-{drive_damping}-{stiffness}"));
        let (log, summary) = flight.fly_with(&snapshot, &folder.0);
        assert_eq!((summary.dropped, summary.brief, summary.error), (0, 0, None));
        holds(&verify(&log).unwrap(), 1500);
        // of seven joints, then their mean forces, then the forces at the ends
        let is_of_an_end = |row: &Value| row["row"].as_u64().unwrap() >= 14;
        let is_bound =
            |tick: &Value| tick["ledger"]["active_rows"].as_array().unwrap().iter().any(is_of_an_end);
        let bound = ticks(&log).iter().filter(|tick| is_bound(tick)).count();
        assert!(stiffness < 1000.0 || bound > 10, "{bound} ticks at the end of a force");
        let other = folder.0.join("copy.mcap");
        let edit = |topic: &str, m: &mut Value| {
            if topic == "tick" && m["tick"] == 700 {
                m["action"][3] = (m["action"][3].as_f64().unwrap() + 1e-4).into();
            }
            true
        };
        copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
        let report = verify(&other).unwrap();
        assert!(report.found == 1 && report.violations[0].tick == 700, "{report}");
    }
}
