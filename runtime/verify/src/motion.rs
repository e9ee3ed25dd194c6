//! Rigid-body dynamics: the recursive Newton-Euler equations over the bodies' own axes (Featherstone, *Rigid Body Dynamics Algorithms*,
//! 2008, table 5.1), and what follows from the same recursion: places, velocities, kinetic energy.

use std::cell::Cell;

use crate::robot::{Joint, JointKind, Robot};
use crate::space::{Place, Vec3, apply, apply_back, cross, dot, minus, norm, plus, times, turn};

/// Angular part, then the linear part at the origin of a link's axes.
type Twist = [Vec3; 2];

/// A joint and all that is rigidly fixed behind it. Its axes are the body's, after the turns of the joints so far.
struct Link {
    parent: Option<usize>,
    /// Its place in the parent link where the joint is at its reference.
    base: Place,
    kind: JointKind,
    axis: Vec3,
    anchor: Vec3,
    reference: f64,
    armature: f64,
    damping: f64,
    drive_damping: f64,
    stiffness: f64,
    spring_reference: f64,
    /// First entry in a configuration.
    idx_q: usize,
    /// Number of the body that its joint moves.
    body: usize,
    mass: f64,
    /// Mass times centre of mass [kg·m].
    moment: Vec3,
    /// About the origin [kg·m²].
    inertia: [Vec3; 3],
}

/// A place on the robot: its link, none for the world, and where it is there.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Spot {
    pub(crate) link: Option<usize>,
    pub(crate) place: Place,
}

/// A point: position [m], velocity [m/s], acceleration [m/s²] while no joint accelerates.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Point {
    pub(crate) at: Vec3,
    pub(crate) velocity: Vec3,
    pub(crate) acceleration: Vec3,
}

/// A robot of hinges, slides and continuous joints, and the scratch of one thread.
pub(crate) struct Machine {
    links: Vec<Link>,
    gravity: Vec3,
    nq: usize,
    /// Names of bodies, then of joints and sites, with where they are.
    spots: Vec<(String, bool, Spot)>,
    /// Rotation and origin of each link in its parent, and in the world.
    local: Vec<Place>,
    world: Vec<Place>,
    velocity: Vec<Twist>,
    acceleration: Vec<Twist>,
    force: Vec<Twist>,
    ahead: Vec<f64>,
    shifted: Vec<f64>,
    still: Vec<f64>,
    /// Steps of work that are left, see [`Machine::grant`].
    left: Cell<i64>,
}

/// Joints at most: what is done in a tick grows with their square.
const JOINTS: usize = 256;
/// Steps of work (a link moved, a distance looked at) that a tick may take on average, and more of them at first.
const EACH: i64 = 500_000;
const FIRST: i64 = 20_000_000;
/// What is said of a robot whose motion is not known here.
pub(crate) const UNKNOWN_ROBOT: &str = "robots of hinges, slides and continuous joints alone are verified";
/// Why a tick is not verified for which no steps are left.
pub(crate) const SPENT: &str = "verifying them takes longer than a log of this length is given";

impl Link {
    fn new(parent: Option<usize>, base: Place, joint: &Joint, idx_q: usize, body: usize) -> Link {
        Link {
            parent,
            base,
            kind: joint.kind,
            axis: joint.axis,
            anchor: joint.anchor,
            reference: joint.reference,
            armature: joint.armature,
            damping: joint.damping,
            drive_damping: joint.drive_damping,
            stiffness: joint.stiffness,
            spring_reference: joint.spring_reference,
            idx_q,
            body,
            mass: 0.0,
            moment: [0.0; 3],
            inertia: [[0.0; 3]; 3],
        }
    }

    /// What a unit of joint velocity does.
    fn subspace(&self) -> Twist {
        match self.kind {
            JointKind::Slide => [[0.0; 3], self.axis],
            _ => [self.axis, cross(self.anchor, self.axis)],
        }
    }

    /// Its place in the parent at configuration `q`.
    fn at(&self, q: &[f64]) -> Place {
        let angle = match self.kind {
            JointKind::Continuous => q[self.idx_q + 1].atan2(q[self.idx_q]),
            _ => q[self.idx_q],
        } - self.reference;
        let joint = match self.kind {
            JointKind::Slide => Place { at: times(angle, self.axis), ..Place::HERE },
            _ => {
                let axes = turn(self.axis, angle);
                Place { at: minus(self.anchor, apply(&axes, self.anchor)), axes }
            }
        };
        self.base.then(&joint)
    }

    /// Adds a body's mass, which stands at `place` on this link.
    fn carry(&mut self, place: &Place, mass: f64, com: Vec3, [xx, xy, xz, yy, yz, zz]: [f64; 6]) {
        let own = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
        let c = place.point(com);
        // R I R' + m (c² 1 - c c').
        let half = own.map(|row| apply(&place.axes, row)); // rows of (R I')' = I R'
        for i in 0..3 {
            for j in 0..3 {
                let turned: f64 = (0..3).map(|k| place.axes[i][k] * half[k][j]).sum();
                let same = if i == j { dot(c, c) } else { 0.0 };
                self.inertia[i][j] += turned + mass * (same - c[i] * c[j]);
            }
        }
        self.moment = plus(self.moment, times(mass, c));
        self.mass += mass;
    }

    /// Momentum of a twist: `(I w + m c x v, m v - m c x w)`.
    fn momentum(&self, [w, v]: Twist) -> Twist {
        [
            plus(apply(&self.inertia, w), cross(self.moment, v)),
            minus(times(self.mass, v), cross(self.moment, w)),
        ]
    }
}

/// A parent's twist in the axes of a link at `place`: the inverse of a change of axes.
fn carried(place: &Place, [w, v]: Twist) -> Twist {
    [apply_back(&place.axes, w), apply_back(&place.axes, plus(v, cross(w, place.at)))]
}

impl Machine {
    /// The robot's numbers as links.
    ///
    /// # Errors
    /// The name of a joint with several degrees of freedom.
    pub(crate) fn new(robot: &Robot) -> Result<Machine, String> {
        let (mut links, mut places, mut spots) = (Vec::<Link>::new(), Vec::<Spot>::new(), Vec::new());
        let fixed = Spot { link: None, place: Place::HERE };
        let mut nq = 0;
        spots.push(("universe".to_owned(), true, fixed));
        for (number, body) in robot.bodies.iter().enumerate() {
            let parent = match body.parent {
                None => fixed,
                Some(k) => *places
                    .get(k)
                    .ok_or_else(|| format!("body '{}' hangs on one that comes later", body.name))?,
            };
            let mut spot = Spot { link: parent.link, place: parent.place.then(&body.placement) };
            for joint in &body.joints {
                let size = match joint.kind {
                    JointKind::Hinge | JointKind::Slide => 1,
                    JointKind::Continuous => 2,
                    _ => {
                        return Err(format!(
                            "joint '{}' has several degrees of freedom, and {UNKNOWN_ROBOT}; `nearl replay` computes its ticks again, and `nearl report` \
                             shows what was measured",
                            joint.name
                        ));
                    }
                };
                links.push(Link::new(spot.link, spot.place, joint, nq, number));
                nq += size;
                spot = Spot { link: Some(links.len() - 1), place: Place::HERE };
                let on_axis = Spot { place: Place { at: joint.anchor, ..Place::HERE }, ..spot };
                spots.push((joint.name.clone(), false, on_axis));
            }
            if let Some(link) = spot.link {
                links[link].carry(&spot.place, body.mass, body.com, body.inertia);
            }
            spots.push((body.name.clone(), true, spot));
            places.push(spot);
        }
        for frame in &robot.frames {
            let on = match frame.body {
                None => fixed,
                Some(k) => *places.get(k).ok_or_else(|| format!("frame '{}' is on no body", frame.name))?,
            };
            spots.push((frame.name.clone(), false, Spot { place: on.place.then(&frame.placement), ..on }));
        }
        let n = links.len();
        if n > JOINTS {
            return Err(format!("it has {n} joints, more than the {JOINTS} that are verified"));
        }
        let (place, twist) = (vec![Place::HERE; n], vec![[[0.0; 3]; 2]; n]);
        Ok(Machine {
            links,
            gravity: robot.gravity,
            nq,
            spots,
            local: place.clone(),
            world: place,
            velocity: twist.clone(),
            acceleration: twist.clone(),
            force: twist,
            ahead: vec![0.0; nq],
            shifted: vec![0.0; n],
            still: vec![0.0; n],
            left: Cell::new(FIRST),
        })
    }

    /// A tick more is to be verified.
    pub(crate) fn grant(&self) {
        self.left.set(self.left.get().saturating_add(EACH).min(1000 * FIRST));
    }

    /// Counts steps of work.
    pub(crate) fn spend(&self, steps: usize) {
        self.left.set(self.left.get().saturating_sub(steps as i64));
    }

    /// No steps of work are left.
    pub(crate) fn is_spent(&self) -> bool {
        self.left.get() <= 0
    }

    /// Number of degrees of freedom, one for each joint.
    pub(crate) fn nv(&self) -> usize {
        self.links.len()
    }

    /// Number of configuration entries.
    pub(crate) fn nq(&self) -> usize {
        self.nq
    }

    /// The configuration entry of a dof that has one alone.
    pub(crate) fn single(&self, dof: usize) -> Option<usize> {
        let link = &self.links[dof];
        (link.kind != JointKind::Continuous).then_some(link.idx_q)
    }

    /// The body called `name`, else the joint or site.
    pub(crate) fn spot(&self, name: &str) -> Option<Spot> {
        let find = |is_body| self.spots.iter().find(|(own, body, _)| own == name && *body == is_body);
        find(true).or_else(|| find(false)).map(|(_, _, spot)| *spot)
    }

    /// `q` moved on along the velocities `v` for `time` [s].
    pub(crate) fn moved(&self, q: &[f64], v: &[f64], time: f64, out: &mut Vec<f64>) {
        out.clear();
        out.extend_from_slice(q);
        for (link, v) in self.links.iter().zip(v) {
            let i = link.idx_q;
            match link.kind {
                JointKind::Continuous => {
                    let (s, c) = (time * v).sin_cos();
                    (out[i], out[i + 1]) = (c * q[i] - s * q[i + 1], s * q[i] + c * q[i + 1]);
                }
                _ => out[i] += time * v,
            }
        }
    }

    /// Moves every link to `q` with velocity `v`, without joint acceleration and gravity.
    pub(crate) fn go(&mut self, q: &[f64], v: &[f64]) {
        self.sweep(q, v, None, [0.0; 3]);
        for k in 0..self.links.len() {
            let local = self.local[k];
            self.world[k] = self.links[k].parent.map_or(local, |p| self.world[p].then(&local));
        }
    }

    /// Velocities and accelerations, outwards. Gravity is an acceleration of the world upwards.
    fn sweep(&mut self, q: &[f64], v: &[f64], a: Option<&[f64]>, gravity: Vec3) {
        self.spend(self.links.len());
        for k in 0..self.links.len() {
            let link = &self.links[k];
            let place = link.at(q);
            let (before, faster) = match link.parent {
                Some(p) => (self.velocity[p], self.acceleration[p]),
                None => ([[0.0; 3]; 2], [[0.0; 3], times(-1.0, gravity)]),
            };
            let [sw, sv] = link.subspace();
            let own = [times(v[k], sw), times(v[k], sv)];
            let [w, u] = carried(&place, before);
            let (w, u) = (plus(w, own[0]), plus(u, own[1]));
            let [dw, du] = carried(&place, faster);
            let turning = [cross(w, own[0]), plus(cross(w, own[1]), cross(u, own[0]))];
            let joint = a.map_or(0.0, |a| a[k]);
            self.velocity[k] = [w, u];
            self.acceleration[k] =
                [plus(plus(dw, times(joint, sw)), turning[0]), plus(plus(du, times(joint, sv)), turning[1])];
            self.local[k] = place;
        }
    }

    /// Joint forces (nv) for the accelerations `a` (nv) at `q`, `v`, springs and dampers aside.
    fn inverse(&mut self, q: &[f64], v: &[f64], a: &[f64], gravity: Vec3, tau: &mut [f64]) {
        self.sweep(q, v, Some(a), gravity);
        for (k, link) in self.links.iter().enumerate() {
            let [w, u] = self.velocity[k];
            let [l, p] = link.momentum(self.velocity[k]);
            let [n, f] = link.momentum(self.acceleration[k]);
            self.force[k] = [plus(n, plus(cross(w, l), cross(u, p))), plus(f, cross(w, p))];
        }
        for k in (0..self.links.len()).rev() {
            let link = &self.links[k];
            let ([n, f], [sw, sv]) = (self.force[k], link.subspace());
            tau[k] = dot(sw, n) + dot(sv, f) + link.armature * a[k];
            if let Some(p) = link.parent {
                let (axes, at) = (&self.local[k].axes, self.local[k].at);
                let (n, f) = (apply(axes, n), apply(axes, f));
                self.force[p][0] = plus(self.force[p][0], plus(n, cross(at, f)));
                self.force[p][1] = plus(self.force[p][1], f);
            }
        }
    }

    /// What the motors give (nv) for the accelerations `a` (nv), on average over a period of `T` with sub-steps `tau`. The plant evaluates its
    /// forces `h = (T - tau) / 2` after the start on average, where the robot has come to `q + h v` and is faster by `h a`:
    ///
    /// ```text
    ///     M(q + h v) a + c(q + h v, v) + h (dc / dv) a + D (v + kappa T a) + K (q + h v + (T² - tau²) / 6 a - rest) + tau D_drive a
    /// ```
    pub(crate) fn motors(
        &mut self,
        period: &crate::Period,
        q: &[f64],
        v: &[f64],
        a: &[f64],
        tau: &mut [f64],
    ) {
        let lag = 0.5 * (period.dt - period.tau);
        let sag = (period.dt * period.dt - period.tau * period.tau) / 6.0;
        let (gravity, mut ahead) = (self.gravity, std::mem::take(&mut self.ahead));
        self.moved(q, v, lag, &mut ahead);
        self.inverse(&ahead, v, a, gravity, tau);
        if lag > 0.0 {
            // The velocity forces are a quadratic form: half of c(v + x) - c(v - x) is its derivative along x, whatever the length of x.
            let (mut shifted, mut still) =
                (std::mem::take(&mut self.shifted), std::mem::take(&mut self.still));
            let mut side = vec![0.0; v.len()];
            for sign in [1.0, -1.0] {
                shifted.iter_mut().zip(v.iter().zip(a)).for_each(|(x, (v, a))| *x = v + sign * lag * a);
                still.fill(0.0);
                self.inverse(&ahead, &shifted, &still, gravity, &mut side);
                tau.iter_mut().zip(&side).for_each(|(tau, side)| *tau += 0.5 * sign * side);
            }
            (self.shifted, self.still) = (shifted, still);
        }
        self.ahead = ahead;
        for (k, link) in self.links.iter().enumerate() {
            tau[k] += link.damping * (v[k] + period.kappa * period.dt * a[k]);
            tau[k] += period.tau * link.drive_damping * a[k];
            if link.stiffness != 0.0 {
                tau[k] += link.stiffness * (q[link.idx_q] + lag * v[k] + sag * a[k] - link.spring_reference);
            }
        }
    }

    /// Stiffness and damping of dof `i` itself [N m/rad or N/m, N m s/rad or N s/m].
    pub(crate) fn spring(&self, i: usize) -> [f64; 2] {
        [self.links[i].stiffness, self.links[i].damping]
    }

    /// What a physics step takes implicitly of dof `i`, its drive's included [N m s/rad or N s/m].
    pub(crate) fn damping(&self, i: usize) -> f64 {
        self.links[i].damping + self.links[i].drive_damping
    }

    /// `M(q) x` (nv).
    pub(crate) fn mass_times(&mut self, q: &[f64], x: &[f64], out: &mut [f64]) {
        let still = vec![0.0; x.len()];
        self.inverse(q, &still, x, [0.0; 3], out);
    }

    /// Kinetic energy [J], rotors included.
    pub(crate) fn energy(&mut self, q: &[f64], v: &[f64]) -> f64 {
        self.sweep(q, v, None, [0.0; 3]);
        let each = self.links.iter().enumerate().map(|(k, link)| {
            let ([w, u], [l, p]) = (self.velocity[k], link.momentum(self.velocity[k]));
            dot(w, l) + dot(u, p) + link.armature * v[k] * v[k]
        });
        0.5 * each.sum::<f64>()
    }

    /// Where `spot` is since the last [`Machine::go`].
    pub(crate) fn place(&self, spot: &Spot) -> Place {
        spot.link.map_or(spot.place, |k| self.world[k].then(&spot.place))
    }

    /// The point of the link of `spot` that is at `at` in the world now.
    pub(crate) fn point(&self, spot: &Spot, at: Vec3) -> Point {
        let Some(k) = spot.link else { return Point { at, velocity: [0.0; 3], acceleration: [0.0; 3] } };
        let world = &self.world[k];
        let x = apply_back(&world.axes, minus(at, world.at));
        let ([w, u], [dw, du]) = (self.velocity[k], self.acceleration[k]);
        let velocity = plus(u, cross(w, x));
        // Spatial to classical: the axes turn under the point.
        let acceleration = plus(plus(du, cross(dw, x)), cross(w, velocity));
        Point { at, velocity: apply(&world.axes, velocity), acceleration: apply(&world.axes, acceleration) }
    }

    /// Adds `scale n' J` to `row` (nv), with `J` the Jacobian of the point of `spot`'s link that is at `at`.
    pub(crate) fn add_row(&self, spot: &Spot, at: Vec3, n: Vec3, scale: f64, row: &mut [f64]) {
        let mut link = spot.link;
        while let Some(k) = link {
            let own = &self.links[k];
            let axis = apply(&self.world[k].axes, own.axis);
            row[k] += scale
                * match own.kind {
                    JointKind::Slide => dot(n, axis),
                    _ => dot(n, cross(axis, minus(at, self.world[k].point(own.anchor)))),
                };
            link = own.parent;
        }
    }

    /// Speed of the point of `spot` [m/s].
    pub(crate) fn speed(&self, spot: &Spot, local: Vec3) -> f64 {
        norm(self.point(spot, self.place(spot).point(local)).velocity)
    }

    /// Whether a motion of `dof` can move `spot`.
    pub(crate) fn moves(&self, dof: usize, spot: &Spot) -> bool {
        let mut link = spot.link;
        while let Some(k) = link {
            if k == dof {
                return true;
            }
            link = self.links[k].parent;
        }
        false
    }

    /// Whether two places are on one moving body, or on two of which one hangs on the other.
    pub(crate) fn are_neighbours(&self, a: &Spot, b: &Spot) -> bool {
        let body = |link: Option<usize>| link.map(|k| self.links[k].body);
        let before = |link: Option<usize>| {
            let own = body(link)?;
            let first = self.links.iter().find(|l| l.body == own)?;
            Some(body(first.parent))
        };
        body(a.link) == body(b.link)
            || before(a.link) == Some(body(b.link))
            || before(b.link) == Some(body(a.link))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::period::Period;

    /// Two hinges about y, 1 kg point masses 1 m and 0.5 m below their axes, the second axis 1 m below the first.
    fn pendulum() -> Machine {
        let body = |name: &str, parent: &str, z: f64, com: f64| {
            format!(
                r#"{{"name":"{name}","parent":{parent},"placement":{{"position":[0,0,{z:?}],"rotation":[[1,0,0],[0,1,0],[0,0,1]]}},"mass":1.0,
                "com":[0,0,{com:?}],"inertia":[0,0,0,0,0,0],"joints":[{{"name":"j{name}","kind":"hinge","axis":[0,1,0],"anchor":[0,0,0],"reference":0.0,
                "range":"unlimited","velocity":null,"effort":null,"damping":0.0,"stiffness":0.0,"spring_reference":0.0,"armature":0.0}}]}}"#
            )
        };
        let text = format!(
            r#"{{"gravity":[0,0,-10],"bodies":[{},{}],"frames":[],"solids":[],"motors":[]}}"#,
            body("a", "null", 0.0, -1.0),
            body("b", "0", -1.0, -0.5)
        );
        Machine::new(&serde_json::from_str(&text).unwrap()).unwrap()
    }

    /// Lagrange's equations of the double pendulum, by hand: lengths 1 and 1/2, masses 1.
    #[test]
    fn forces_and_energy_are_those_of_a_double_pendulum() {
        let mut machine = pendulum();
        let (q, v, a): ([f64; 2], [f64; 2], [f64; 2]) = ([0.4, -0.9], [1.3, 0.7], [2.0, -3.0]);
        let (c, s) = (q[1].cos(), q[1].sin());
        let mass = [[2.0 + c + 0.25, 0.25 + 0.5 * c], [0.25 + 0.5 * c, 0.25]];
        let turning = [-0.5 * s * v[1] * (2.0 * v[0] + v[1]), 0.5 * s * v[0] * v[0]];
        let weight = 10.0 * 0.5 * (q[0] + q[1]).sin();
        let gravity = [10.0 * 2.0 * q[0].sin() + weight, weight];
        let mut tau = [0.0; 2];
        machine.motors(&Period::new(0.001, 1), &q, &v, &a, &mut tau);
        for i in 0..2 {
            let by_hand = mass[i][0] * a[0] + mass[i][1] * a[1] + turning[i] + gravity[i];
            assert!((tau[i] - by_hand).abs() < 1e-12, "{i}: {} {by_hand}", tau[i]);
        }
        let energy: f64 = (0..2).map(|i| 0.5 * v[i] * (mass[i][0] * v[0] + mass[i][1] * v[1])).sum();
        assert!((machine.energy(&q, &v) - energy).abs() < 1e-12);
    }

    /// The motion of the lower mass, and its Jacobian, by differences of its place.
    #[test]
    fn a_point_moves_as_its_place_does() {
        let mut machine = pendulum();
        let spot = machine.spot("b").unwrap();
        let (q, v) = ([0.4, -0.9], [1.3, 0.7]);
        let mut place = |time: f64| {
            machine.go(&[q[0] + time * v[0], q[1] + time * v[1]], &v);
            machine.place(&spot).point([0.0, 0.0, -0.5])
        };
        let (h, now) = (1e-4, place(0.0));
        let (ahead, behind) = (place(h), place(-h));
        machine.go(&q, &v);
        let point = machine.point(&spot, now);
        let mut row = [0.0; 2];
        machine.add_row(&spot, now, [1.0, 0.0, 0.0], 1.0, &mut row);
        assert!((row[0] * v[0] + row[1] * v[1] - point.velocity[0]).abs() < 1e-12);
        for k in 0..3 {
            assert!((point.velocity[k] - (ahead[k] - behind[k]) / (2.0 * h)).abs() < 1e-7);
            assert!((point.acceleration[k] - (ahead[k] - 2.0 * now[k] + behind[k]) / (h * h)).abs() < 1e-5);
        }
    }
}
