//! `[random]`: a robot that is a little different in every episode.
//!
//! ```toml
//! [random]
//! mass = "1 + 0.2 * uniform"                    # factor on mass and inertia of every body, one draw a body
//! com = { base = "0.03 * uniform" }             # m, added to every axis of the centre of mass of this body
//! friction = { all = "0.8 + 0.4 * uniform" }    # factor, one draw for all
//! strength = "0.9 + 0.1 * uniform"              # factor on the force of every motor
//! bumps = "level"                               # factor from 0 to 1 on the height of the floor's bumps
//! ```

use rand_chacha::ChaCha8Rng;
use std::ops::RangeInclusive;

use super::commands::{drawn, is_ever};
use super::expression::Expression;
use super::quantity::{Names, Quantity};
use super::settings::{Mistake, Text, mistake};
use crate::mj::{Actuator, Model, Physique};

/// What differs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Mass,
    Inertia,
    Centre,
    Friction,
    Strength,
    Stiffness,
    Damping,
    Armature,
    Bumps,
}

const KINDS: [(&str, Kind); 9] = [
    ("mass", Kind::Mass),
    ("inertia", Kind::Inertia),
    ("com", Kind::Centre),
    ("friction", Kind::Friction),
    ("strength", Kind::Strength),
    ("stiffness", Kind::Stiffness),
    ("damping", Kind::Damping),
    ("armature", Kind::Armature),
    ("bumps", Kind::Bumps),
];

/// One expression and what it is drawn for.
#[derive(Clone)]
struct Draw {
    kind: Kind,
    /// Bodies, solids or actuators.
    entries: Vec<usize>,
    /// One draw for all of them.
    together: bool,
    of: Expression<Quantity>,
}

/// The robot as its file has it, and how it differs in this episode.
#[derive(Clone)]
pub(super) struct Random {
    nominal: Physique,
    pub(super) physique: Physique,
    /// Number among MuJoCo's controls, and degree of freedom, of each actuator.
    places: Vec<(usize, usize)>,
    /// Factor on the force of each entry of the action, for motors that MuJoCo does not know.
    pub(super) strength: Vec<f64>,
    draws: Vec<Draw>,
    /// Mean of what was drawn in this episode, by draw.
    means: Vec<f64>,
}

impl Random {
    /// Reads the section; none where the task has none.
    pub(super) fn read(
        section: &toml::Table,
        model: &Model,
        actuators: &[Actuator],
        start: &Names,
    ) -> Result<Option<Random>, Mistake> {
        if section.is_empty() {
            return Ok(None);
        }
        let mut draws = Vec::new();
        for (name, value) in section {
            let key = format!("random.{name}");
            let Some((_, kind)) = KINDS.iter().find(|(known, _)| known == name) else {
                let known: Vec<_> = KINDS.iter().map(|(known, _)| *known).collect();
                return Err(mistake(
                    key,
                    format!("nothing of that name can differ; there are {}", known.join(", ")),
                ));
            };
            let able = kind.able(model, actuators);
            if let Some(reason) = kind.none().filter(|_| able.is_empty()) {
                return Err(mistake(key, reason));
            }
            let names = kind.names(model, actuators);
            match value {
                toml::Value::Table(by_name) => {
                    for (entry, value) in by_name {
                        let key = format!("{key}.{entry}");
                        draws.push(Draw::read(&key, *kind, entry, value, (&able, &names), start)?);
                    }
                }
                value => {
                    let of = kind.factor(&key, value, start)?;
                    let together = matches!(kind, Kind::Friction | Kind::Bumps);
                    draws.push(Draw { kind: *kind, entries: able, together, of });
                }
            }
        }
        let nominal = model.physique();
        Ok(Some(Random {
            physique: nominal.clone(),
            nominal,
            places: actuators.iter().map(|actuator| (actuator.control, actuator.dof)).collect(),
            strength: vec![1.0; actuators.len()],
            means: vec![f64::NAN; draws.len()],
            draws,
        }))
    }

    /// Names of [`Random::notes`].
    pub(super) fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = Vec::new();
        for draw in &self.draws {
            let name = KINDS.iter().find(|(_, kind)| *kind == draw.kind).map_or("", |(name, _)| name);
            let before = names.iter().filter(|n| n.starts_with(&format!("random/{name}"))).count();
            names.push(if before == 0 {
                format!("random/{name}")
            } else {
                format!("random/{name}_{before}")
            });
        }
        names
    }

    /// Mean of what was drawn for the present episode, draw by draw.
    pub(super) fn notes(&self) -> &[f64] {
        &self.means
    }

    /// Draws the robot of an episode.
    pub(super) fn draw(&mut self, rng: &mut ChaCha8Rng, level: f64) {
        self.physique.clone_from(&self.nominal);
        self.strength.fill(1.0);
        for (draw, mean) in self.draws.iter().zip(&mut self.means) {
            let (mut sum, mut count) = (0.0, 0.0);
            let mut value = 0.0;
            for (i, &entry) in draw.entries.iter().enumerate() {
                let axes = if draw.kind == Kind::Centre { 3 } else { 1 };
                for axis in 0..axes {
                    if !(draw.together && i > 0) {
                        value = draw.kind.within(drawn(&draw.of, rng, level));
                    }
                    (sum, count) = (sum + value, count + 1.0);
                    let (physique, strength) = (&mut self.physique, &mut self.strength);
                    draw.kind.apply(physique, strength, &self.places, entry, axis, value);
                }
            }
            *mean = sum / count;
        }
    }
}

impl Draw {
    fn read(
        key: &str,
        kind: Kind,
        entry: &str,
        value: &toml::Value,
        (able, names): (&[usize], &[String]),
        start: &Names,
    ) -> Result<Draw, Mistake> {
        let of = kind.factor(key, value, start)?;
        if entry == "all" {
            return Ok(Draw { kind, entries: able.to_vec(), together: true, of });
        }
        let at = names.iter().position(|name| name == entry).ok_or_else(|| {
            let near = names.iter().map(|name| (strsim::jaro(name, entry), name));
            let near = near
                .max_by(|a, b| a.0.total_cmp(&b.0))
                .map_or(String::new(), |(_, n)| format!("; did you mean '{n}'?"));
            mistake(key, format!("there is no '{entry}' of which it could be{near}"))
        })?;
        if !able.contains(&at) {
            let reason = format!(
                "'{entry}' cannot differ in it: it is the world, a body alone whose inertia MuJoCo simplifies, a motor that is no drive, or \
                 one of a joint without armature"
            );
            return Err(mistake(key, reason));
        }
        Ok(Draw { kind, entries: vec![at], together: false, of })
    }
}

impl Kind {
    /// Names of what may differ, by entry.
    fn names(self, model: &Model, actuators: &[Actuator]) -> Vec<String> {
        match self {
            Kind::Mass | Kind::Inertia | Kind::Centre => model.body_names(),
            Kind::Friction => (0..model.physique().friction.len()).map(|i| format!("solid{i}")).collect(),
            Kind::Bumps => (0..model.physique().bumps.len()).map(|i| format!("field{i}")).collect(),
            _ => actuators.iter().map(|actuator| actuator.name.clone()).collect(),
        }
    }

    /// Why nothing of the robot may differ in it, and what to do.
    fn none(self) -> Option<&'static str> {
        match self {
            Kind::Stiffness | Kind::Damping => Some(
                "no motor of the robot is a drive with such a gain; take it out, or command the joints 'pd' (factors on the forces of motors are 'strength')",
            ),
            Kind::Bumps => {
                Some("the floor is flat; give it bumps (scene.floor.bumps, in m), or take this out")
            }
            Kind::Armature => Some(
                "no joint with a motor has an armature; write armature = \"...\" for its joint in the robot file, or take this out",
            ),
            Kind::Centre => Some(
                "MuJoCo simplifies the inertia of every body, which counts on its centre of mass being where it is; take this out",
            ),
            _ => None,
        }
    }

    /// Which entries may differ: every body but the world, centres of mass where MuJoCo counts on none at the joint, gains of drives, and the armature
    /// of each joint once.
    fn able(self, model: &Model, actuators: &[Actuator]) -> Vec<usize> {
        let (n, physique) = (self.names(model, actuators).len(), model.physique());
        let bias = &physique.bias;
        let first = |i: usize| actuators.iter().position(|a| a.dof == actuators[i].dof) == Some(i);
        let has_gain =
            |i: &usize, k: usize| bias.get(actuators[*i].control).is_some_and(|bias| bias[k] != 0.0);
        match self {
            Kind::Mass | Kind::Inertia => (1..n).collect(),
            Kind::Centre => (1..n).filter(|body| !model.is_simple(*body)).collect(),
            Kind::Stiffness => (0..n).filter(|i| has_gain(i, 1)).collect(),
            Kind::Damping => (0..n).filter(|i| has_gain(i, 2)).collect(),
            Kind::Armature => {
                (0..n).filter(|i| physique.armature[actuators[*i].dof] != 0.0 && first(*i)).collect()
            }
            _ => (0..n).collect(),
        }
    }

    /// The factors that physics can have.
    fn domain(self) -> RangeInclusive<f64> {
        match self {
            Kind::Centre => f64::MIN..=f64::MAX,
            Kind::Mass | Kind::Inertia => 0.01..=f64::MAX,
            // MuJoCo looks for contacts within the height that was compiled.
            Kind::Bumps => 0.0..=1.0,
            _ => 0.0..=f64::MAX,
        }
    }

    /// The nearest factor that physics can have.
    fn within(self, value: f64) -> f64 {
        let domain = self.domain();
        value.max(*domain.start()).min(*domain.end())
    }

    /// Reads what is drawn, and refuses what is never a factor that physics can have.
    fn factor(self, key: &str, value: &toml::Value, start: &Names) -> Result<Expression<Quantity>, Mistake> {
        let (of, domain) = (Text::read(key, value, start)?, self.domain());
        if is_ever(&of, &domain) {
            return Ok(of);
        }
        let reason = match *domain.end() == f64::MAX {
            true => format!("no factor that is drawn is {} or more", domain.start()),
            false => format!("no factor that is drawn is from {} to {}", domain.start(), domain.end()),
        };
        Err(mistake(key, reason))
    }

    fn apply(
        self,
        p: &mut Physique,
        strength: &mut [f64],
        places: &[(usize, usize)],
        entry: usize,
        axis: usize,
        value: f64,
    ) {
        let by = |x: &mut f64| *x *= value;
        let (control, dof) = places.get(entry).copied().unwrap_or_default();
        match self {
            Kind::Mass => {
                by(&mut p.mass[entry]);
                p.inertia[entry].iter_mut().for_each(by);
            }
            Kind::Inertia => p.inertia[entry].iter_mut().for_each(by),
            Kind::Centre => p.centre[entry][axis] += value,
            Kind::Friction => by(&mut p.friction[entry][0]),
            Kind::Armature => by(&mut p.armature[dof]),
            Kind::Bumps => by(&mut p.bumps[entry]),
            Kind::Strength if p.gain.is_empty() => by(&mut strength[entry]),
            Kind::Strength => {
                by(&mut p.gain[control]);
                p.bias[control].iter_mut().for_each(by);
                p.force_range[control].iter_mut().for_each(by);
            }
            Kind::Stiffness => {
                by(&mut p.gain[control]);
                by(&mut p.bias[control][1]);
            }
            Kind::Damping => by(&mut p.bias[control][2]),
        }
    }
}
