//! The pairs of solids that can touch, listed once. MuJoCo searches for them in every evaluation (axes of the cloud of solids, their boxes,
//! a sweep), which is a tenth of a step where there are few. What touches, how, and in which order stays the same, bit for bit.

use std::cmp::Ordering;
use std::path::Path;

use mujoco_rs::error::MjEditError;
use mujoco_rs::mujoco_c::{mjtDisableBit, mjtEnableBit};
use mujoco_rs::wrappers::mj_editing::{MjSpec, SpecElement, SpecItem};
use mujoco_rs::wrappers::mj_model::{MjModel, MjtObjBase};

use super::{MjError, Scene, scene};

/// What the name of a listed pair begins with.
const LISTED: &str = "nearl: ";

/// Pairs for each solid above which looking at all of them would take longer than the search.
const MOST: usize = 2;

/// What a contact of two solids is like, as MuJoCo mixes it of theirs.
struct Mixed {
    condim: i32,
    friction: [f64; 3],
    solref: [f64; 2],
    solimp: [f64; 5],
    adhesion: f64,
}

/// `model`, compiled from the other arguments, with its pairs listed; as it was where the file lists pairs itself, has flexible bodies or
/// sleeps, or where too many pairs can touch.
pub(super) fn list(
    text: &str,
    folder: Option<&Path>,
    scene: &Scene,
    model: MjModel,
) -> Result<MjModel, MjError> {
    let pairs = can_touch(&model);
    let n_solids = (0..model.geom_contype().len()).filter(|&id| is_solid(&model, id)).count();
    if model.npair() > 0
        || model.nflex() > 0
        || sleeps(&model)
        || pairs.is_empty()
        || pairs.len() > MOST * n_solids
    {
        return Ok(model);
    }
    // Names are given by place in the specification, which the first compilation says the numbers of.
    let (mut named, files) = scene::specify(text, folder, scene)?;
    name_all(&mut named).map_err(scene::words)?;
    let numbered = named.compile_with_vfs(&files).map_err(scene::words)?;
    let name = |id: usize| numbered.id_to_name(MjtObjBase::mjOBJ_GEOM, id).unwrap_or_default();
    let (mut spec, files) = scene::specify(text, folder, scene)?;
    name_all(&mut spec).map_err(scene::words)?;
    for &(a, b) in &pairs {
        let mixed = Mixed::of(&model, a, b);
        let pair = spec.add_pair();
        pair.set_name(&format!("{LISTED}{a} and {b}")).map_err(scene::words)?;
        pair.with_geomname1(name(a)).with_geomname2(name(b));
        pair.with_condim(mixed.condim).with_solref(mixed.solref).with_solimp(mixed.solimp);
        pair.with_friction(five(mixed.friction)).with_adhesion(mixed.adhesion);
        pair.with_margin(model.geom_margin()[a] + model.geom_margin()[b]);
        pair.with_gap(model.geom_gap()[a] + model.geom_gap()[b]);
    }
    let mut listed = spec.compile_with_vfs(&files).map_err(scene::words)?;
    // The search leaves bodies out that touch nothing. What the solids themselves say stays as it is in the file.
    listed.body_contype_mut().fill(0);
    listed.body_conaffinity_mut().fill(0);
    Ok(listed)
}

/// Friction of each listed pair where the solids have `friction`; nothing where the pairs are those of the file.
pub(super) fn frictions(m: &MjModel, friction: &[[f64; 3]]) -> Vec<[f64; 5]> {
    let first = if m.npair() > 0 { m.id_to_name(MjtObjBase::mjOBJ_PAIR, 0) } else { None };
    if !first.is_some_and(|name| name.starts_with(LISTED)) {
        return Vec::new();
    }
    let pairs = m.pair_geom1().iter().zip(m.pair_geom2());
    pairs.map(|(a, b)| five(mixed_friction(m, friction, *a as usize, *b as usize))).collect()
}

fn name_all(spec: &mut MjSpec) -> Result<(), MjEditError> {
    for (place, geom) in spec.geom_iter_mut().enumerate() {
        if geom.name().is_empty() {
            geom.set_name(&format!("{LISTED}solid {place}"))?;
        }
    }
    Ok(())
}

/// Whether MuJoCo lets robots at rest sleep.
pub(super) fn sleeps(m: &MjModel) -> bool {
    m.opt().enableflags & mjtEnableBit::mjENBL_SLEEP as i32 != 0
}

/// Whether a geom can touch anything.
pub(super) fn is_solid(m: &MjModel, id: usize) -> bool {
    m.geom_contype()[id] != 0 || m.geom_conaffinity()[id] != 0
}

/// MuJoCo's filters: masks, bodies that are welded to each other or to a common parent, and excluded bodies; in its order.
fn can_touch(m: &MjModel) -> Vec<(usize, usize)> {
    let parents_touch = m.opt().disableflags & mjtDisableBit::mjDSBL_FILTERPARENT as i32 != 0;
    let body = |id: usize| m.geom_bodyid()[id] as usize;
    let weld = |body: usize| m.body_weldid()[body] as usize;
    let allowed = |a: usize, b: usize| {
        let masks = m.geom_contype()[a] & m.geom_conaffinity()[b] != 0
            || m.geom_contype()[b] & m.geom_conaffinity()[a] != 0;
        let (first, second) = (weld(body(a)), weld(body(b)));
        let parent = |of: usize| weld(m.body_parentid()[of] as usize);
        let moves = m.body_dofnum()[first] > 0 || m.body_dofnum()[second] > 0;
        let related = first != 0
            && second != 0
            && (first == parent(second) || second == parent(first))
            && !parents_touch;
        let signature = ((body(a).min(body(b)) << 16) + body(a).max(body(b))) as i32;
        masks && first != second && moves && !related && !m.exclude_signature().contains(&signature)
    };
    let n = m.geom_contype().len();
    let mut pairs: Vec<_> =
        (0..n).flat_map(|a| (a + 1..n).map(move |b| (a, b))).filter(|&(a, b)| allowed(a, b)).collect();
    pairs.sort_by_key(|&(a, b)| (body(a).min(body(b)), body(a).max(body(b)), a, b));
    pairs
}

impl Mixed {
    /// `mj_contactParam` of MuJoCo: the solid with the higher priority decides; of equal ones each number is mixed in its own way.
    fn of(m: &MjModel, a: usize, b: usize) -> Mixed {
        let alone = |id: usize| Mixed {
            condim: m.geom_condim()[id],
            friction: mixed_friction(m, m.geom_friction(), a, b),
            solref: m.geom_solref()[id],
            solimp: m.geom_solimp()[id],
            adhesion: m.geom_adhesion()[id],
        };
        let (one, two) = (alone(a), alone(b));
        match m.geom_priority()[a].cmp(&m.geom_priority()[b]) {
            Ordering::Greater => return one,
            Ordering::Less => return two,
            Ordering::Equal => {}
        }
        let [first, second] = [a, b].map(|id| m.geom_solmix()[id]);
        let share = match (first >= TINY, second >= TINY) {
            (true, true) => first / (first + second),
            (false, false) => 0.5,
            (has, _) => f64::from(u8::from(has)),
        };
        let mix = |x: f64, y: f64| share * x + (1.0 - share) * y;
        let standard = one.solref[0] > 0.0 && two.solref[0] > 0.0;
        let reference = |x: f64, y: f64| if standard { mix(x, y) } else { x.min(y) };
        Mixed {
            condim: one.condim.max(two.condim),
            friction: one.friction,
            solref: std::array::from_fn(|k| reference(one.solref[k], two.solref[k])),
            solimp: std::array::from_fn(|k| mix(one.solimp[k], two.solimp[k])),
            adhesion: one.adhesion + two.adhesion,
        }
    }
}

fn mixed_friction(m: &MjModel, friction: &[[f64; 3]], a: usize, b: usize) -> [f64; 3] {
    match m.geom_priority()[a].cmp(&m.geom_priority()[b]) {
        Ordering::Greater => friction[a],
        Ordering::Less => friction[b],
        Ordering::Equal => std::array::from_fn(|k| friction[a][k].max(friction[b][k])),
    }
}

/// `mjMINVAL`.
const TINY: f64 = 1e-15;

/// Both tangents, the spin, both rolls.
fn five([slide, spin, roll]: [f64; 3]) -> [f64; 5] {
    [slide, slide, spin, roll, roll]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mj::{Model, ModelFormat, Options, Sim};
    use crate::{robot, tasks};
    use rand::{RngExt, SeedableRng};
    use std::sync::Arc;

    fn bits(sim: &Sim) -> Vec<u64> {
        sim.qpos().iter().chain(sim.qvel()).map(|x| x.to_bits()).collect()
    }

    /// Random actions on both, from the same state; how often something touched.
    fn fall(what: &str, listed: &mut Sim, searched: &mut Sim) -> usize {
        let (mut random, mut touched) = (rand_chacha::ChaCha8Rng::seed_from_u64(7), 0);
        for step in 0..600 {
            for control in 0..listed.model().nu() {
                let value = random.random_range(-1.0..1.0);
                (listed.ctrl_mut()[control], searched.ctrl_mut()[control]) = (value, value);
            }
            listed.step(5).expect("listed");
            searched.step(5).expect("searched");
            assert_eq!(bits(listed), bits(searched), "{what}, step {step}");
            touched += usize::from(listed.data().ncon() > 0);
        }
        touched
    }

    /// Two limbs that hit each other and the floor: solids of unlike priorities, frictions, margins, masks; an excluded pair.
    const UNLIKE: &str = r#"<mujoco><option timestep="0.002"/><worldbody>
        <geom type="plane" size="0 0 1" friction="0.3 0.01 0.001" solref="0.01 0.8" solmix="2" margin="0.01" gap="0.004"/>
        <body name="a" pos="0 0 0.4"><joint name="ax" type="slide" axis="1 0 0" range="-1 1"/><joint name="az" type="slide" axis="0 0 1"/>
          <joint name="ar" axis="0 1 0"/><geom type="capsule" size="0.05 0.1" friction="1.5" condim="6" priority="1"/>
          <geom type="box" size="0.08 0.08 0.05" pos="0 0 -0.15" solref="-900 -20" margin="0.005"/>
          <body name="c" pos="0.2 0 0"><joint name="cr" axis="0 1 0"/><geom type="sphere" size="0.06" pos="0.1 0 0" condim="1"/></body></body>
        <body name="b" pos="0.5 0 0.4"><joint name="bx" type="slide" axis="1 0 0"/><joint name="bz" type="slide" axis="0 0 1"/>
          <joint name="br" axis="0 1 0"/><geom type="ellipsoid" size="0.1 0.05 0.07" solimp="0.8 0.9 0.01"/>
          <geom type="cylinder" size="0.04 0.1" pos="0 0 0.2" contype="2" conaffinity="1"/></body>
        </worldbody><contact><exclude body1="b" body2="c"/></contact><actuator><motor joint="ax" gear="40"/><motor joint="bx" gear="40"/>
        <motor joint="ar" gear="5"/><motor joint="br" gear="5"/></actuator></mujoco>"#;

    #[test]
    fn a_list_of_pairs_changes_no_bit() {
        let bundled = ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5"].map(|task| {
            let manifest = tasks::load(task, &[]).expect("task");
            (task, robot::simulation(&manifest).expect("bundled").text)
        });
        for (what, text) in bundled.into_iter().chain([("unlike", UNLIKE.to_owned())]) {
            let listed = Model::from_text(&text, ModelFormat::Mjcf, Options::default()).expect("robot");
            let mut raw = scene::compile(&text, None, &Scene::default()).expect("robot");
            assert!(listed.0.npair() > 0 && raw.npair() == 0, "{what}");
            assert_eq!(listed.0.geom_contype(), raw.geom_contype(), "{what}: what solids say of themselves");
            raw.opt_mut().disableflags = listed.0.opt().disableflags;
            let searched = Model(Arc::new(raw));
            let (mut a, mut b) = (Sim::apart(&listed).expect("a"), Sim::apart(&searched).expect("b"));
            assert!(fall(what, &mut a, &mut b) > 100, "{what} touched nothing");
            let mut other = listed.physique();
            other.friction.iter_mut().enumerate().for_each(|(i, f)| *f = [0.2 + 0.1 * i as f64, 0.02, 0.003]);
            for sim in [&mut a, &mut b] {
                sim.change(&other).expect("change");
                sim.reset().expect("reset");
            }
            assert!(fall(what, &mut a, &mut b) > 100, "{what}, other frictions");
        }
    }

    #[test]
    fn a_file_that_lists_pairs_itself_keeps_them() {
        let own = UNLIKE
            .replace("<exclude", "<pair geom1=\"foot\" geom2=\"floor\"/><exclude")
            .replace("type=\"plane\"", "name=\"floor\" type=\"plane\"")
            .replace("type=\"sphere\"", "name=\"foot\" type=\"sphere\"");
        let model = Model::from_text(&own, ModelFormat::Mjcf, Options::default()).expect("robot");
        assert_eq!(model.0.npair(), 1);
        assert!(model.0.body_contype().iter().any(|&mask| mask != 0));
        assert!(frictions(&model.0, model.0.geom_friction()).is_empty());
    }
}
