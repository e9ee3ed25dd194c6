//! Vectors, rotations and places in three dimensions.

/// Three coordinates.
pub(crate) type Vec3 = [f64; 3];

pub(crate) fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(crate) fn plus(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(crate) fn minus(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn times(s: f64, a: Vec3) -> Vec3 {
    [s * a[0], s * a[1], s * a[2]]
}

pub(crate) fn norm(a: Vec3) -> f64 {
    dot(a, a).sqrt()
}

/// A matrix by rows.
pub(crate) type Mat3 = [[f64; 3]; 3];

pub(crate) const ONE: Mat3 = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

pub(crate) fn apply(m: &Mat3, a: Vec3) -> Vec3 {
    [dot(m[0], a), dot(m[1], a), dot(m[2], a)]
}

/// `m' a`.
pub(crate) fn apply_back(m: &Mat3, a: Vec3) -> Vec3 {
    plus(plus(times(a[0], m[0]), times(a[1], m[1])), times(a[2], m[2]))
}

pub(crate) fn product(a: &Mat3, b: &Mat3) -> Mat3 {
    a.map(|row| apply_back(b, row))
}

/// Rotation by `angle` [rad] about the unit vector `n`: `1 + sin [n]x + (1 - cos) [n]x²`.
pub(crate) fn turn(n: Vec3, angle: f64) -> Mat3 {
    let (s, c) = angle.sin_cos();
    let column = |e: Vec3| {
        let across = cross(n, e);
        plus(plus(e, times(s, across)), times(1.0 - c, cross(n, across)))
    };
    let columns = [column(ONE[0]), column(ONE[1]), column(ONE[2])];
    [0, 1, 2].map(|i| [columns[0][i], columns[1][i], columns[2][i]])
}

/// Where something is in its parent: `x_parent = at + axes x`.
#[derive(Clone, Copy, Debug, serde::Deserialize)]
pub(crate) struct Place {
    /// Origin [m].
    #[serde(rename = "position")]
    pub(crate) at: Vec3,
    /// Rotation by rows.
    #[serde(rename = "rotation")]
    pub(crate) axes: Mat3,
}

impl Place {
    pub(crate) const HERE: Place = Place { at: [0.0; 3], axes: ONE };

    /// `self`, then `inner` in its axes.
    pub(crate) fn then(&self, inner: &Place) -> Place {
        Place { at: self.point(inner.at), axes: product(&self.axes, &inner.axes) }
    }

    pub(crate) fn point(&self, local: Vec3) -> Vec3 {
        plus(self.at, apply(&self.axes, local))
    }
}
