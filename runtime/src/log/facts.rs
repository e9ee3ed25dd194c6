//! The metadata of a flight log: what replay needs beside the ticks and the snapshots.

use std::collections::BTreeMap;

use nearl_constraints::{Kind, Rung};
use serde::{Deserialize, Serialize};

use super::tick::SCHEMA_VERSION;
use crate::codes::LedgerStatus;
use crate::link::{Message, ROBOT_LIMITS, RobotMessage};
use crate::rt::{CoreSettings, FaultPlan, Mode};
use crate::snapshot::one_line;

/// The plant's description as readable facts.
#[derive(Debug, Serialize, Deserialize)]
struct RobotFacts {
    joints: Vec<String>,
    /// Hash over all joint names, those beyond the capacity of a message included.
    joints_hash: u64,
    observation: u64,
    limits: u64,
    dt: f64,
    nq: u32,
    nv: u32,
    nu: u32,
    n_obs: u32,
    bits: u32,
}

/// Units of the numbers of a tick; those of the vectors are for a hinge, and m in place of rad for a slide.
const UNITS: [(&str, &str); 10] = [
    ("q", "rad"),
    ("v", "rad/s"),
    ("proposal_q, target_q", "rad"),
    ("proposal_v, target_v", "rad/s"),
    ("action, applied", "what `commands` says of each joint"),
    ("brake", "rad/s^2"),
    ("multiplier of a joint's row", "rad/s"),
    ("multiplier of another row", "(rad/s)^2 per unit of the row"),
    ("time", "s"),
    ("*_ns", "ns of the monotonic clock; `clock` is what the wall clock was ahead of it"),
];

/// What [`read`] finds again.
#[derive(Debug)]
pub(crate) struct Session {
    pub(crate) robot: RobotMessage,
    pub(crate) core: CoreSettings,
    pub(crate) faults: FaultPlan,
}

/// Facts of a run as strings, as MCAP metadata has them.
pub fn facts(robot: &RobotMessage, core: &CoreSettings, faults: &FaultPlan) -> BTreeMap<String, String> {
    let joints = robot.joint_names();
    let described = RobotFacts {
        joints: joints.clone(),
        joints_hash: robot.joints,
        observation: robot.observation,
        limits: robot.limits,
        dt: robot.dt,
        nq: robot.nq,
        nv: robot.nv,
        nu: robot.nu,
        n_obs: robot.n_obs,
        bits: robot.bits,
    };
    fn json(what: &str, value: &impl Serialize) -> (String, String) {
        let text = serde_json::to_string(value).unwrap_or_else(|e| unreachable!("{what}: {e}"));
        (what.to_owned(), text)
    }
    [
        ("schema".to_owned(), SCHEMA_VERSION.to_string()),
        ("dt".to_owned(), robot.dt.to_string()),
        ("joints".to_owned(), joints.join(",")),
        ("rungs".to_owned(), Rung::ALL.map(Rung::name).join(",")),
        json(
            "statuses",
            &LedgerStatus::ALL.iter().map(|s| (s.number(), s.name())).collect::<BTreeMap<_, _>>(),
        ),
        json("kinds", &Kind::ALL.map(Kind::name)),
        json("modes", &Mode::ALL.iter().map(|mode| mode.name()).collect::<Vec<_>>()),
        json("units", &BTreeMap::from(UNITS)),
        json("robot", &described),
        json("settings", core),
        json("faults", faults),
    ]
    .into()
}

/// Refuses a log of another schema, whose ticks may have other fields; the error is one clause.
pub(crate) fn check_schema(facts: &BTreeMap<String, String>) -> Result<(), String> {
    let version = facts.get("schema").ok_or("its metadata has no `schema`")?;
    match *version == SCHEMA_VERSION.to_string() {
        true => Ok(()),
        false => Err(format!(
            "its schema is {version}, this build replays {SCHEMA_VERSION}; replay it with the build that wrote it"
        )),
    }
}

/// Reads the facts back; the error is one clause.
pub(crate) fn read(facts: &BTreeMap<String, String>) -> Result<Session, String> {
    let get = |key: &str| facts.get(key).ok_or_else(|| format!("its metadata has no `{key}`"));
    check_schema(facts)?;
    fn parse<T: for<'de> Deserialize<'de>>(key: &str, text: &str) -> Result<T, String> {
        serde_json::from_str(text).map_err(|e| format!("its metadata `{key}` is damaged: {e}"))
    }
    let described: RobotFacts = parse("robot", get("robot")?)?;
    for (key, value) in [("dt", described.dt.to_string()), ("joints", described.joints.join(","))] {
        let said = get(key)?;
        if *said != value {
            let said = one_line(said);
            return Err(format!(
                "its metadata `{key}` is '{said}', and that of its robot '{value}': one of the two was changed"
            ));
        }
    }
    let mut robot = RobotMessage::zeroed();
    robot.set_joint_names(&described.joints);
    robot.joints = described.joints_hash;
    (robot.observation, robot.limits, robot.dt) = (described.observation, described.limits, described.dt);
    (robot.nq, robot.nv, robot.nu) = (described.nq, described.nv, described.nu);
    // The limits were compared when the run began; their numbers are not in the log.
    (robot.n_obs, robot.bits) = (described.n_obs, described.bits & !ROBOT_LIMITS);
    Ok(Session {
        robot,
        core: parse("settings", get("settings")?)?,
        faults: parse("faults", get("faults")?)?,
    })
}
