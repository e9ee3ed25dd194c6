//! Where an episode begins that a task says nothing else of: at the initial positions of the robot file, whatever keyframes stand in it.

use mujoco_rs::mujoco_c::mjtDisableBit;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use toml::Table;

use super::{Joint, JointKind, Model};

/// Positions may lie this far outside a range: files are rounded [rad or m].
const ROUNDED: f64 = 1e-6;

impl Model {
    /// What whoever starts an episode there may not expect, one sentence each; of what `reset`, the task's section, says nothing.
    pub(crate) fn starts(&self, reset: &Table) -> Vec<String> {
        let placed = reset.get("q").and_then(toml::Value::as_table);
        let mut told = Vec::new();
        if placed.is_none_or(Table::is_empty) {
            told.extend(self.keyframes());
        }
        let is_free = |joint: &&Joint| !placed.is_some_and(|placed| placed.contains_key(&joint.name));
        let outside: Vec<_> =
            self.joints().iter().filter(is_free).filter_map(|joint| self.outside(joint)).collect();
        if !outside.is_empty() {
            let (found, placed): (Vec<String>, Vec<String>) = outside.into_iter().unzip();
            told.push(format!(
                "episodes begin outside of the range of {}; write positions inside in [reset], such as q = {{ {} }}",
                found.join(", "),
                placed.join(", ")
            ));
        }
        told
    }

    fn keyframes(&self) -> Option<String> {
        let m = &self.0;
        let name = |id: usize| self.name(MjtObjBase::mjOBJ_KEY, id).unwrap_or(format!("number {id}"));
        let names: Vec<String> = (0..m.key_time().len()).map(name).collect();
        let chosen = names.iter().position(|name| name == "home").unwrap_or(0);
        let at = m.key_qpos().chunks_exact(self.nq().max(1)).nth(chosen)?;
        let (mut placed, mut turned) = (Vec::new(), Vec::new());
        for joint in self.joints() {
            let (parts, is_turned): (&[&str], bool) = match joint.kind {
                JointKind::Free => (&[".x", ".y", ".z"], true),
                JointKind::Ball => (&[], true),
                JointKind::Slide | JointKind::Hinge => (&[""], false),
            };
            let differs = |k: &usize| (at[*k] - self.qpos0()[*k]).abs() > ROUNDED;
            for (part, k) in parts.iter().zip(joint.idx_q..).filter(|(_, k)| differs(k)) {
                placed.push(format!("{} = {}", key(&format!("{}{part}", joint.name)), rounded(at[k])));
            }
            if is_turned && (joint.idx_q + parts.len()..joint.idx_q + joint.nq).any(|k| differs(&k)) {
                turned.push(format!("'{}'", joint.name));
            }
        }
        if placed.is_empty() && turned.is_empty() {
            return None;
        }
        let all = names.iter().map(|name| format!("'{name}'")).collect::<Vec<_>>().join(", ");
        let (begin, placed) = (&names[chosen], placed.join(", "));
        let left = match turned.is_empty() {
            true => String::new(),
            false => format!(", which leaves the rotation of {} as it is", turned.join(", ")),
        };
        Some(format!(
            "keyframes are not read ({all}): episodes begin at the robot file's initial positions; to begin at '{begin}', write q = {{ {placed} }} in \
             [reset]{left}"
        ))
    }

    /// A joint whose initial position its own range does not allow, and the nearest that it does, as `[reset]` has it.
    fn outside(&self, joint: &Joint) -> Option<(String, String)> {
        let unit = match joint.kind {
            JointKind::Hinge => "rad",
            JointKind::Slide => "m",
            JointKind::Free | JointKind::Ball => return None,
        };
        let off =
            self.disables(mjtDisableBit::mjDSBL_LIMIT) || self.disables(mjtDisableBit::mjDSBL_CONSTRAINT);
        let ([lower, upper], at) = (joint.range, self.qpos0()[joint.idx_q]);
        let inside = at >= lower - ROUNDED && at <= upper + ROUNDED;
        if off || inside || lower > upper {
            return None;
        }
        let (name, end) = (&joint.name, if at < lower { lower } else { upper });
        let [at, lower, upper, end] = [at, lower, upper, end].map(rounded);
        Some((format!("'{name}' ({at} {unit}, {lower} to {upper})"), format!("{} = {end}", key(name))))
    }
}

/// A key of a task file.
fn key(name: &str) -> String {
    let bare = |c: char| c.is_ascii_alphanumeric() || "_-".contains(c);
    if !name.is_empty() && name.chars().all(bare) { name.to_string() } else { format!("{name:?}") }
}

/// To six decimals, without the sign of a zero.
fn rounded(x: f64) -> String {
    (format!("{x:.6}").parse().unwrap_or(x) + 0.0).to_string()
}
