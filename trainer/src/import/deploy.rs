//! `deploy.yaml` of unitree_rl_lab and unitree_rl_mjlab as a recipe: joints by the number of their motor, gains, observation terms.
//!
//! A motor's number is its place in unitree's SDK. For a quadruped that is the legs FR, FL, RR, RL; for other robots the order of the robot file.

use serde::Deserialize;
use serde::de::{MapAccess, Visitor};
use toml::{Table, Value};

/// Legs in the order of the SDK, and the joints of each.
const LEGS: [&str; 4] = ["FR", "FL", "RR", "RL"];
const OF_A_LEG: [&str; 3] = ["hip", "thigh", "calf"];

/// The entries of a plant's observation that a velocity command is read from.
const COMMAND: [&str; 3] = ["command.lin_vel_x", "command.lin_vel_y", "command.ang_vel_z"];

#[derive(Deserialize)]
struct Deploy {
    joint_ids_map: Vec<usize>,
    step_dt: f64,
    stiffness: Vec<f64>,
    damping: Vec<f64>,
    default_joint_pos: Vec<f64>,
    actions: Ordered<Action>,
    observations: Ordered<Term>,
}

/// Outputs of a policy do not go so far: a clip from there on cuts none.
const FAR: f64 = 20.0;

#[derive(Deserialize)]
struct Action {
    clip: Option<Vec<[f64; 2]>>,
    scale: Option<Numbers>,
    offset: Option<Numbers>,
    joint_ids: Option<Vec<usize>>,
}

#[derive(Deserialize)]
struct Term {
    #[serde(default)]
    params: serde_json::Value,
    clip: Option<[f64; 2]>,
    scale: Option<Numbers>,
    history_length: Option<i64>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Numbers {
    One(f64),
    Each(Vec<f64>),
}

impl From<Numbers> for Value {
    fn from(numbers: Numbers) -> Value {
        match numbers {
            Numbers::One(x) => x.into(),
            Numbers::Each(all) => all.into(),
        }
    }
}

/// A map in the order of its file.
struct Ordered<T>(Vec<(String, T)>);

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Ordered<T> {
    fn deserialize<D: serde::Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Entries<T>(std::marker::PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for Entries<T> {
            type Value = Ordered<T>;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a map of names")
            }
            fn visit_map<M: MapAccess<'de>>(self, mut map: M) -> Result<Ordered<T>, M::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(Ordered(entries))
            }
        }
        from.deserialize_map(Entries(std::marker::PhantomData))
    }
}

/// The recipe that the text of a `deploy.yaml` is for a robot with these joints in the order of its file; the error is one clause.
pub(super) fn recipe(text: &str, joints: &[String]) -> Result<Table, String> {
    let said: Deploy = serde_saphyr::from_str(text).map_err(|e| {
        let words = e.to_string();
        format!("it is no deploy.yaml: {}", words.lines().next().unwrap_or_default())
    })?;
    let motors = motors(joints);
    let n = said.joint_ids_map.len();
    let mut named = Vec::new();
    for id in &said.joint_ids_map {
        let motor = motors.get(*id).filter(|motor| !named.contains(*motor));
        let motor = motor.ok_or_else(|| {
            format!(
                "joint_ids_map: there is no motor {id} in a robot of {} joints, or it stands there twice",
                motors.len()
            )
        })?;
        named.push(motor.clone());
    }
    for (key, values) in [("stiffness", &said.stiffness), ("damping", &said.damping)] {
        if values.len() != motors.len() {
            return Err(format!("{key}: {} numbers for a robot of {} joints", values.len(), motors.len()));
        }
    }
    if said.default_joint_pos.len() != n {
        return Err(format!("default_joint_pos: {} numbers for {n} joints", said.default_joint_pos.len()));
    }
    let by_joint = |values: &[f64]| {
        let of_policy = said.joint_ids_map.iter().map(|id| (motors[*id].clone(), Value::from(values[*id])));
        Value::from(Table::from_iter(of_policy))
    };
    let command = [
        ("interface", Value::from("pd")),
        ("stiffness", by_joint(&said.stiffness)),
        ("damping", by_joint(&said.damping)),
    ];
    let remembers = said.observations.0.iter().any(|(name, _)| name.contains("action"));
    let policy = [
        ("action", action(said.actions, &said.default_joint_pos, remembers)?),
        ("observation", terms(said.observations, &named)?),
        ("pose", said.default_joint_pos.into()),
        ("joints", named.clone().into()),
    ];
    Ok(table([
        ("time", table([("dt", said.step_dt.into())]).into()),
        ("command", table(command).into()),
        // Balance cannot be promised: the drives' forces are what is bounded.
        ("constraints", table([("guard", "drive".into()), ("torque", Table::new().into())]).into()),
        ("policy", table(policy).into()),
    ]))
}

fn table<const N: usize>(entries: [(&str, Value); N]) -> Table {
    entries.into_iter().map(|(key, value)| (key.to_string(), value)).collect()
}

/// The joints by the number of their motor.
fn motors(joints: &[String]) -> Vec<String> {
    let legs = || LEGS.iter().flat_map(|leg| OF_A_LEG.map(|joint| format!("{leg}_{joint}_joint")));
    match joints.len() == 12 && legs().all(|leg| joints.contains(&leg)) {
        true => legs().collect(),
        false => joints.to_vec(),
    }
}

/// Their clip is of targets, after scale and offset, and a recipe's of outputs, before them: `(clip - offset) / scale`.
fn action(actions: Ordered<Action>, pose: &[f64], remembers: bool) -> Result<Value, String> {
    let mut actions = actions.0;
    let names = || "its actions are none but JointPositionAction, which is what is read".to_string();
    let (name, action) = actions.pop().ok_or_else(names)?;
    if name != "JointPositionAction" || !actions.is_empty() {
        return Err(names());
    }
    if action.joint_ids.is_some() {
        return Err("JointPositionAction.joint_ids: an action of some joints alone is not read".into());
    }
    let of = |numbers: &Option<Numbers>, i: usize, otherwise: f64| match numbers {
        None => Some(otherwise),
        Some(Numbers::One(x)) => Some(*x),
        Some(Numbers::Each(all)) => all.get(i).copied(),
    };
    let outputs = |(i, ends): (usize, &[f64; 2])| {
        let (scale, offset) = (of(&action.scale, i, 1.0)?, of(&action.offset, i, *pose.get(i)?)?);
        let [low, high] = ends.map(|end| (end - offset) / scale);
        (scale != 0.0).then_some([low.min(high), low.max(high)])
    };
    let clip =
        action.clip.as_ref().map(|clip| clip.iter().enumerate().map(outputs).collect::<Option<Vec<_>>>());
    let wrong = || "JointPositionAction.clip does not fit its scale and offset".to_string();
    let clip = clip.map(|clip| clip.ok_or_else(wrong)).transpose()?;
    if remembers && clip.iter().flatten().flatten().any(|end| end.abs() < FAR) {
        return Err(
            "JointPositionAction.clip cuts targets that the policy sees uncut as its last action, and a recipe's clip cuts both; leave it out, and bound \
             the targets by limits on positions"
                .into(),
        );
    }
    let mut said = Table::new();
    let numbers = [("scale", action.scale), ("offset", action.offset)];
    said.extend(numbers.into_iter().filter_map(|(key, value)| Some((key.to_string(), value?.into()))));
    if let Some(clip) = clip {
        let side = |side: usize| Value::from(clip.iter().map(|ends| ends[side]).collect::<Vec<_>>());
        said.insert("clip".into(), vec![side(0), side(1)].into());
    }
    Ok(said.into())
}

/// The joints of a term, which its `params.asset_cfg.joint_ids` numbers in the policy's order.
fn joints_of(term: &Term, name: &str, named: &[String]) -> Result<Option<Vec<Value>>, String> {
    let Some(ids) = term.params.pointer("/asset_cfg/joint_ids").and_then(|ids| ids.as_array()) else {
        return Ok(None);
    };
    let joint =
        |id: &serde_json::Value| Some(Value::from(named.get(usize::try_from(id.as_u64()?).ok()?)?.clone()));
    let joints = ids.iter().map(joint).collect::<Option<Vec<_>>>();
    joints.map(Some).ok_or_else(|| {
        format!("observations: joint_ids of '{name}' names a joint that the policy does not have")
    })
}

/// The terms in their order; their names are those of recipes, or refused there.
fn terms(observations: Ordered<Term>, named: &[String]) -> Result<Value, String> {
    let mut terms = Vec::new();
    for (name, said) in observations.0 {
        if name == "gait_phase" {
            return Err("observations: 'gait_phase' depends on the command there; describe it in a recipe of your own".into());
        }
        let mut term = table([("history", said.history_length.unwrap_or(1).max(1).into())]);
        if name == "velocity_commands" {
            term.insert("entries".into(), COMMAND.map(Value::from).to_vec().into());
        }
        if let Some(joints) = joints_of(&said, &name, named)? {
            term.insert("joints".into(), joints.into());
        }
        term.insert("term".into(), name.into());
        if let Some(scale) = said.scale {
            term.insert("scale".into(), scale.into());
        }
        if let Some(clip) = said.clip {
            term.insert("clip".into(), clip.map(Value::from).to_vec().into());
        }
        terms.push(Value::from(term));
    }
    Ok(terms.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn motors_of_a_quadruped_are_numbered_from_its_front_right_leg() {
        let file = ["FL", "FR", "RL", "RR"]
            .iter()
            .flat_map(|leg| OF_A_LEG.map(|joint| format!("{leg}_{joint}_joint")));
        let joints: Vec<String> = file.collect();
        let motors = motors(&joints);
        assert_eq!(
            (motors[0].as_str(), motors[3].as_str(), motors[8].as_str()),
            ("FR_hip_joint", "FL_hip_joint", "RR_calf_joint")
        );
        assert_eq!(super::motors(&joints[..11]), joints[..11]);
    }
}
