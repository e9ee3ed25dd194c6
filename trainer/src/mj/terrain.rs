//! Bumps on the floor of a scene: a field of heights, flat where episodes begin.

use mujoco_rs::mujoco_c::mju_rayGeom;
use mujoco_rs::wrappers::mj_editing::{MjSpec, SpecItem};
use mujoco_rs::wrappers::mj_model::MjtGeomBase;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::{Sim, pairs};

/// Distance of two nodes \[m\].
const CELL: f64 = 0.2;
/// Nodes along each side; the middle one is the origin.
const NODES: usize = 151;
/// Within this distance from the origin the floor is flat \[m\]; from twice of it on, bumps have their full height.
const START: f64 = 0.7;
/// How far the field's lowest point lies below the plane around it \[m\], so that nothing touches both where there is no bump.
const BELOW: f64 = 1e-3;
/// Depth of the field's ground \[m\].
const DEPTH: f64 = 1.0;

/// Where rays that look for the ground begin \[m\].
const ABOVE: f64 = 100.0;
/// Half of a side \[m\].
const HALF: f64 = 0.5 * CELL * (NODES - 1) as f64;

/// Puts bumps of up to `height` \[m\] onto the floor.
pub(super) fn add_to(spec: &mut MjSpec, height: f64, friction: f64) {
    let field = spec.add_hfield().with_name("bumps").with_size([HALF, HALF, height, DEPTH]);
    field.with_nrow(NODES as i32).with_ncol(NODES as i32).set_userdata(heights());
    let bumps = spec.world_body_mut().add_geom().with_name("bumps").with_type(MjtGeomBase::mjGEOM_HFIELD);
    bumps.with_hfieldname("bumps").with_pos([0.0, 0.0, -BELOW]).with_friction([friction, 0.005, 1e-4]);
    bumps.with_contype(1).with_conaffinity(1).with_condim(3);
}

/// Heights between 0 and 1 of the nodes, row by row along y: the same ones always.
fn heights() -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let at = |i: usize| CELL * i as f64 - HALF;
    let mut heights = Vec::with_capacity(NODES * NODES);
    for row in 0..NODES {
        for column in 0..NODES {
            let full = (at(row).hypot(at(column)) / START - 1.0).clamp(0.0, 1.0);
            heights.push((full * rng.random::<f64>()) as f32);
        }
    }
    heights
}

impl Sim {
    /// Height of the highest solid of the world at a place \[m\], as MuJoCo's own ray from above meets it; 0 where nothing is.
    pub fn ground(&self, x: f64, y: f64) -> f64 {
        let m = &self.model().0;
        let touches = |id: &usize| pairs::is_solid(m, *id);
        let of_world = |id: &usize| m.geom_bodyid()[*id] == 0 && touches(id);
        let solids = (0..m.geom_bodyid().len()).filter(of_world);
        let highest = solids.map(|id| self.top(id, x, y)).fold(f64::NEG_INFINITY, f64::max);
        if highest.is_finite() { highest } else { 0.0 }
    }

    /// Height of a solid's upper side at a place \[m\]; negative infinity where it is not.
    fn top(&self, id: usize, x: f64, y: f64) -> f64 {
        let (m, d) = (&self.model().0, self.data());
        let (from, down) = ([x, y, ABOVE], [0.0, 0.0, -1.0]);
        let distance = match m.geom_type()[id] {
            MjtGeomBase::mjGEOM_HFIELD => d.ray_hfield(id, &from, &down, None),
            MjtGeomBase::mjGEOM_MESH | MjtGeomBase::mjGEOM_SDF => return f64::NEG_INFINITY,
            shape => {
                let (at, turned, size) = (&d.geom_xpos()[id], &d.geom_xmat()[id], &m.geom_size()[id]);
                // SAFETY: six arrays of the lengths that MuJoCo reads, and no place for a normal.
                unsafe { mju_rayGeom(at, turned, size, &from, &down, shape as i32, std::ptr::null_mut()) }
            }
        };
        if distance < 0.0 { f64::NEG_INFINITY } else { ABOVE - distance }
    }
}
