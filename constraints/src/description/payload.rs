//! What a robot carries: a tool, a workpiece.

use super::check::{is_indefinite, is_of_mass};
use super::{Body, RobotDescription};
use crate::error::{ModelError, near_names};
use crate::geometry::Placement;
use serde::{Deserialize, Serialize};

/// `{ frame = "panda_hand", mass = 1.2, com = [0, 0, 0.1] }`: a body held fast in a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Payload {
    /// A link or site of the robot file.
    pub frame: String,
    /// Mass \[kg\].
    pub mass: f64,
    /// Centre of mass in the frame's axes \[m\].
    #[serde(default)]
    pub com: [f64; 3],
    /// Inertia about the centre of mass in the frame's axes, `xx, xy, xz, yy, yz, zz` [kg·m²].
    #[serde(default)]
    pub inertia: [f64; 6],
}

impl RobotDescription {
    /// Whether there is a body or a frame of this name.
    pub fn has_frame(&self, name: &str) -> bool {
        self.bodies.iter().any(|body| body.name == name) || self.frames.iter().any(|frame| frame.name == name)
    }

    /// Adds a payload to the body that holds it. With masses `m`, centres of mass `c` and inertias `I` of both, in the body's axes,
    ///
    /// ```text
    ///     m = m1 + m2,   c = (m1 c1 + m2 c2) / m,   I = sum_k I_k + m_k (|c_k - c|^2 - (c_k - c)(c_k - c)')
    /// ```
    ///
    /// # Errors
    /// A frame that the robot does not have or that does not move, numbers that are not finite, a mass that is not positive, an inertia that no body has.
    pub fn carry(&mut self, payload: &Payload) -> Result<(), ModelError> {
        let impossible = |list: String| ModelError::Impossible { file: "the payload".into(), list };
        let (body, placement) = self.holder(&payload.frame)?;
        // What hangs on the world without a joint in between weighs on no motor.
        let mut link = body;
        while let Some(b) = link.filter(|b| self.bodies[*b].joints.is_empty()) {
            link = self.bodies[b].parent;
        }
        let (Some(body), Some(_)) = (body, link) else {
            let frame = &payload.frame;
            return Err(impossible(format!("frame '{frame}' is fixed to the world and carries nothing")));
        };
        let numbers = payload.com.iter().chain(&payload.inertia);
        if !(payload.mass > 0.0 && payload.mass.is_finite()) || numbers.into_iter().any(|x| !x.is_finite()) {
            let (mass, com, inertia) = (payload.mass, payload.com, payload.inertia);
            return Err(impossible(format!("mass {mass} kg, com {com:?} m, inertia {inertia:?} kg·m²")));
        }
        if is_indefinite(payload.inertia) || !is_of_mass(payload.inertia) {
            return Err(impossible(format!(
                "inertia {:?} kg·m² is that of no body about its centre of mass; its entries are xx, xy, xz, yy, yz, zz",
                payload.inertia
            )));
        }
        add(&mut self.bodies[body], payload.mass, payload.com, payload.inertia, &placement);
        Ok(())
    }

    /// The body that a frame is on, and where.
    fn holder(&self, name: &str) -> Result<(Option<usize>, Placement), ModelError> {
        if let Some(body) = self.bodies.iter().position(|b| b.name == name) {
            return Ok((Some(body), Placement::IDENTITY));
        }
        let frame = self.frames.iter().find(|f| f.name == name);
        frame.map(|f| (f.body, f.placement)).ok_or_else(|| {
            let known = self
                .bodies
                .iter()
                .map(|b| b.name.as_str())
                .chain(self.frames.iter().map(|f| f.name.as_str()));
            ModelError::UnknownFrame { name: name.to_string(), near: near_names(name, known) }
        })
    }
}

/// Adds what is held at `placement` in the body's axes: mass \[kg\], centre of mass \[m\] and inertia about it [kg·m²], in axes of its own.
pub(super) fn add(body: &mut Body, mass: f64, com: [f64; 3], inertia: [f64; 6], placement: &Placement) {
    let (m1, m2) = (body.mass, mass);
    let (c1, c2) = (body.com, placement.place(com));
    let c = match m1 + m2 > 0.0 {
        true => std::array::from_fn(|k| (m1 * c1[k] + m2 * c2[k]) / (m1 + m2)),
        false => c1,
    };
    let held = turned(full(inertia), &placement.rotation);
    let (own, first, second) = (full(body.inertia), about(m1, c1, c), about(m2, c2, c));
    let sum = |i: usize, j: usize| own[i][j] + first[i][j] + held[i][j] + second[i][j];
    body.inertia = [sum(0, 0), sum(0, 1), sum(0, 2), sum(1, 1), sum(1, 2), sum(2, 2)];
    (body.mass, body.com) = (m1 + m2, c);
}

fn full([xx, xy, xz, yy, yz, zz]: [f64; 6]) -> [[f64; 3]; 3] {
    [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
}

/// `R I R'`.
fn turned(inertia: [[f64; 3]; 3], r: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let entry =
        |i: usize, j: usize| (0..9).map(|k| r[i][k / 3] * inertia[k / 3][k % 3] * r[j][k % 3]).sum::<f64>();
    std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)))
}

/// What a point mass at `at` adds to the inertia about `c`.
fn about(mass: f64, at: [f64; 3], c: [f64; 3]) -> [[f64; 3]; 3] {
    let d: [f64; 3] = std::array::from_fn(|k| at[k] - c[k]);
    let square: f64 = d.iter().map(|x| x * x).sum();
    let diagonal = |i: usize, j: usize| if i == j { square } else { 0.0 };
    std::array::from_fn(|i| std::array::from_fn(|j| mass * (diagonal(i, j) - d[i] * d[j])))
}
