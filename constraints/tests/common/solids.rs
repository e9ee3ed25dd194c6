//! Solids around a Panda.

use nearl_constraints::geometry::Shape;
use nearl_constraints::limit::{CollisionSettings, SolidSettings};
use nearl_constraints::*;

pub fn solid(frame: &str, shape: Shape, position: [f64; 3]) -> SolidSettings {
    SolidSettings { name: None, frame: Some(frame.into()), shape, position, rpy: [0.0; 3] }
}

pub fn obstacle(name: &str, shape: Shape, position: [f64; 3]) -> SolidSettings {
    SolidSettings { name: Some(name.into()), frame: None, shape, position, rpy: [0.0; 3] }
}

/// A Panda in capsules and balls, over a floor and beside a post and a box.
pub fn panda_solids() -> Vec<SolidSettings> {
    let capsule = |radius, length| Shape::Capsule { radius, length };
    vec![
        solid("panda_link2", capsule(0.08, 0.2), [0.0; 3]),
        solid("panda_link3", capsule(0.07, 0.2), [0.0, 0.0, -0.12]),
        solid("panda_link4", Shape::Sphere { radius: 0.09 }, [-0.08, 0.06, 0.0]),
        solid("panda_link5", capsule(0.06, 0.2), [0.0, 0.0, -0.2]),
        solid("panda_link6", Shape::Sphere { radius: 0.08 }, [0.06, 0.0, 0.0]),
        solid("panda_hand", capsule(0.05, 0.1), [0.0, 0.0, 0.05]),
        obstacle("floor", Shape::HalfSpace, [0.0, 0.0, -0.02]),
        obstacle("post", Shape::Cylinder { radius: 0.05, length: 1.2 }, [0.5, 0.35, 0.5]),
        obstacle("crate", Shape::Box { size: [0.3, 0.3, 0.3] }, [0.45, -0.4, 0.15]),
    ]
}

pub fn panda_collision(rows: usize, influence: f64) -> CollisionLimit {
    CollisionLimit::new(CollisionSettings { shapes: panda_solids(), rows, influence, ..settings(&[]) })
}

pub fn settings(shapes: &[SolidSettings]) -> CollisionSettings {
    CollisionSettings {
        shapes: shapes.to_vec(),
        urdf: false,
        ignore: Vec::new(),
        adjacent: false,
        braking: 0.8,
        margin: 0.005,
        influence: 0.2,
        rows: 8,
        soft: None,
    }
}
