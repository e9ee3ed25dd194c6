//! Contacts of bodies, followed from control period to control period.

use super::expression::Expression;
use super::quantity::Quantity;
use crate::mj::{Model, Sim};

/// Contacts of the bodies that some expression names; the entries of the others stay 0.
#[derive(Clone, Default)]
pub(super) struct Contacts {
    bodies: Vec<usize>,
    /// Sum of a body's normal forces \[N\] (n_bodies).
    pub(super) load: Vec<f64>,
    /// Time since a body's last contact \[s\] (n_bodies).
    pub(super) air: Vec<f64>,
    /// Time in the air before the contact that began in this control period \[s\] (n_bodies).
    pub(super) landed: Vec<f64>,
}

impl Contacts {
    /// Those that `expressions` name.
    pub(super) fn of<'e>(
        model: &Model,
        expressions: impl Iterator<Item = &'e Expression<Quantity>>,
    ) -> Contacts {
        let body = |quantity| match quantity {
            Quantity::Load(body) | Quantity::Contact(body) | Quantity::Air(body) | Quantity::Landed(body) => {
                Some(body)
            }
            _ => None,
        };
        let mut bodies: Vec<usize> = expressions.flat_map(Expression::quantities).filter_map(body).collect();
        bodies.sort_unstable();
        bodies.dedup();
        let zero = vec![0.0; model.n_bodies()];
        Contacts { bodies, load: zero.clone(), air: zero.clone(), landed: zero }
    }

    pub(super) fn clear(&mut self) {
        [&mut self.load, &mut self.air, &mut self.landed].into_iter().for_each(|list| list.fill(0.0));
    }

    pub(super) fn follow(&mut self, sim: &Sim, dt: f64) {
        if self.bodies.is_empty() {
            return;
        }
        sim.contact_loads(&mut self.load);
        for &body in &self.bodies {
            let touches = self.load[body] > 0.0;
            self.landed[body] = if touches { self.air[body] } else { 0.0 };
            self.air[body] = if touches { 0.0 } else { self.air[body] + dt };
        }
    }
}
