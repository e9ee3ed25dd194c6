//! Networks and statistics as the tensors of a snapshot.

use super::{PolicyKind, SnapshotError};
use crate::net::Dense;
use crate::normaliser::Normaliser;
use safetensors::tensor::{Dtype, TensorView};

const MARGINS: &str = "reached.margins";

/// The numbers of a policy, as the learner hands them to a controller.
#[derive(Clone, Debug, PartialEq)]
pub struct Networks {
    /// Observation normaliser and scale of change.
    pub normaliser: Normaliser,
    /// Meta policy (n_obs -> n_state), or n_obs -> n_act for [`PolicyKind::Direct`].
    pub policy: Dense,
    /// Log standard deviation of the policy's Gaussian; empty when deterministic.
    pub policy_log_std: Vec<f32>,
    /// Learned inverse dynamics (n_input -> n_act) and its log standard deviation.
    pub idm: Option<(Dense, Vec<f32>)>,
    /// The margins of `[constraints] reached` as the controllers of the training learned them; empty without it, and before they did.
    pub margins: Vec<f64>,
}

pub(super) struct Tensor {
    pub(super) name: String,
    pub(super) dtype: Dtype,
    pub(super) shape: Vec<usize>,
    pub(super) bytes: Vec<u8>,
}

fn f32s(name: String, shape: Vec<usize>, values: &[f32]) -> Tensor {
    Tensor { name, dtype: Dtype::F32, shape, bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect() }
}
fn f64s(name: &str, values: &[f64]) -> Tensor {
    let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    Tensor { name: name.into(), dtype: Dtype::F64, shape: vec![values.len()], bytes }
}

impl Networks {
    pub(super) fn have_skip(&self) -> bool {
        self.policy.skip.is_some() || self.idm.as_ref().is_some_and(|(dense, _)| dense.skip.is_some())
    }

    /// Whether a tensor of this name is one of a snapshot.
    pub(super) fn knows(name: &str) -> bool {
        let (net, rest) = name.split_once('.').unwrap_or((name, ""));
        match net {
            "reached" => rest == "margins",
            "normaliser" => ["mean", "std", "scale", "lower", "upper"].contains(&rest),
            "policy" | "idm" => {
                let layer = rest.strip_suffix(".weight").or_else(|| rest.strip_suffix(".bias"));
                ["skip", "log_std"].contains(&rest) || layer.is_some_and(|i| i.parse::<usize>().is_ok())
            }
            _ => false,
        }
    }

    /// Refuses what a reader of the snapshot would refuse: weights that are NaN, infinite or huge, of a training that diverged, and statistics of
    /// observations that are no numbers of a robot.
    ///
    /// # Errors
    /// [`SnapshotError::Value`], [`SnapshotError::Far`].
    pub fn check(&self) -> Result<(), SnapshotError> {
        let Normaliser { mean, std, scale, .. } = &self.normaliser;
        for (name, values) in
            [("normaliser.mean", mean), ("normaliser.std", std), ("normaliser.scale", scale)]
        {
            within_reach(name, values)?;
        }
        let idm = self.idm.iter().map(|(dense, log_std)| ("idm", dense, log_std));
        for (net, dense, log_std) in
            std::iter::once(("policy", &self.policy, &self.policy_log_std)).chain(idm)
        {
            for (i, layer) in dense.layers.iter().enumerate() {
                sound(&layer.weight, || format!("{net}.{i}.weight"))?;
                sound(&layer.bias, || format!("{net}.{i}.bias"))?;
            }
            sound(dense.skip.as_deref().unwrap_or_default(), || format!("{net}.skip"))?;
            sound(log_std, || format!("{net}.log_std"))?;
        }
        Ok(())
    }

    pub(super) fn tensors(&self) -> Vec<Tensor> {
        let mut out = vec![
            f64s("normaliser.mean", &self.normaliser.mean),
            f64s("normaliser.std", &self.normaliser.std),
            f64s("normaliser.scale", &self.normaliser.scale),
        ];
        if !self.normaliser.clip.is_empty() {
            let side = |i: usize| self.normaliser.clip.iter().map(|c| c[i]).collect::<Vec<f64>>();
            out.push(f64s("normaliser.lower", &side(0)));
            out.push(f64s("normaliser.upper", &side(1)));
        }
        if !self.margins.is_empty() {
            out.push(f64s(MARGINS, &self.margins));
        }
        let mut net = |prefix: &str, dense: &Dense, log_std: &[f32]| {
            for (i, l) in dense.layers.iter().enumerate() {
                out.push(f32s(format!("{prefix}.{i}.weight"), vec![l.n_out, l.n_in], &l.weight));
                out.push(f32s(format!("{prefix}.{i}.bias"), vec![l.n_out], &l.bias));
            }
            if let Some(skip) = &dense.skip {
                out.push(f32s(format!("{prefix}.skip"), vec![dense.n_out(), dense.n_in()], skip));
            }
            out.push(f32s(format!("{prefix}.log_std"), vec![log_std.len()], log_std));
        };
        net("policy", &self.policy, &self.policy_log_std);
        if let Some((dense, log_std)) = &self.idm {
            net("idm", dense, log_std);
        }
        out
    }

    pub(super) fn read(
        views: &[(String, TensorView<'_>)],
        policy: PolicyKind,
    ) -> Result<Self, SnapshotError> {
        let normaliser = Normaliser {
            mean: far(views, "normaliser.mean")?,
            std: far(views, "normaliser.std")?,
            scale: far(views, "normaliser.scale")?,
            clip: read_clip(views)?,
        };
        for (name, values) in [("normaliser.std", &normaliser.std), ("normaliser.scale", &normaliser.scale)] {
            if let Some((index, &value)) = values.iter().enumerate().find(|(_, v)| **v <= 0.0) {
                return Err(SnapshotError::Value { name: name.into(), index, value });
            }
        }
        let (policy_net, policy_log_std) = read_net(views, "policy")?;
        let has_idm = views.iter().any(|(n, _)| n.starts_with("idm."));
        let idm = if has_idm && policy != PolicyKind::Direct { Some(read_net(views, "idm")?) } else { None };
        let has_margins = views.iter().any(|(n, _)| n == MARGINS);
        let margins = if has_margins { read_f64(views, MARGINS)? } else { Vec::new() };
        Ok(Self { normaliser, policy: policy_net, policy_log_std, idm, margins })
    }
}

/// Weights beyond this are refused: no trained network of this kind has them.
pub const HUGE: f64 = 1e6;
/// Means and standard deviations of observations and of changes of the state beyond this are refused, in their own units.
pub const FAR: f64 = 1e12;

fn find<'a, 'b>(
    views: &'a [(String, TensorView<'b>)],
    name: &str,
    dtype: Dtype,
    rank: usize,
) -> Result<&'a TensorView<'b>, SnapshotError> {
    let view = &views
        .iter()
        .find(|(n, _)| n == name)
        .ok_or_else(|| SnapshotError::MissingTensor { name: name.into() })?
        .1;
    if view.dtype() != dtype || view.shape().len() != rank {
        return Err(SnapshotError::Shape {
            name: name.into(),
            expected: format!("{dtype:?} with {rank} dimension(s)"),
            actual: format!("{:?} {:?}", view.dtype(), view.shape()),
        });
    }
    Ok(view)
}

fn checked<T: Copy + Into<f64>>(name: &str, values: Vec<T>) -> Result<Vec<T>, SnapshotError> {
    sound(&values, || name.into()).map(|()| values)
}

fn sound<T: Copy + Into<f64>>(values: &[T], name: impl Fn() -> String) -> Result<(), SnapshotError> {
    match first_beyond(values, HUGE) {
        Some((index, value)) => Err(SnapshotError::Value { name: name(), index, value }),
        None => Ok(()),
    }
}

/// The first of `values` that is no number, or larger than `most`, and where it stands.
pub fn first_beyond<T: Copy + Into<f64>>(values: &[T], most: f64) -> Option<(usize, f64)> {
    let mut all = values.iter().enumerate().map(|(i, &v)| (i, v.into()));
    all.find(|(_, v)| !v.is_finite() || v.abs() > most)
}

fn doubles(views: &[(String, TensorView<'_>)], name: &str) -> Result<Vec<f64>, SnapshotError> {
    let view = find(views, name, Dtype::F64, 1)?;
    Ok(view.data().as_chunks::<8>().0.iter().map(|c| f64::from_le_bytes(*c)).collect())
}

fn read_f64(views: &[(String, TensorView<'_>)], name: &str) -> Result<Vec<f64>, SnapshotError> {
    checked(name, doubles(views, name)?)
}

/// Statistics in units of the user's.
fn far(views: &[(String, TensorView<'_>)], name: &str) -> Result<Vec<f64>, SnapshotError> {
    let values = doubles(views, name)?;
    within_reach(name, &values).map(|()| values)
}

fn within_reach(name: &str, values: &[f64]) -> Result<(), SnapshotError> {
    match first_beyond(values, FAR) {
        Some((index, value)) => Err(SnapshotError::Far { name: name.into(), index, value }),
        None => Ok(()),
    }
}

/// `normaliser.lower` and `normaliser.upper`, which may be infinite; empty where the file has neither.
fn read_clip(views: &[(String, TensorView<'_>)]) -> Result<Vec<[f64; 2]>, SnapshotError> {
    if !views.iter().any(|(n, _)| n == "normaliser.lower" || n == "normaliser.upper") {
        return Ok(Vec::new());
    }
    let (lower, upper) = (doubles(views, "normaliser.lower")?, doubles(views, "normaliser.upper")?);
    if lower.len() != upper.len() {
        return Err(SnapshotError::Shape {
            name: "normaliser.upper".into(),
            expected: format!("{} wide", lower.len()),
            actual: format!("{} wide", upper.len()),
        });
    }
    // also refuses what is not a number
    if let Some(index) =
        lower.iter().zip(&upper).position(|(l, u)| !matches!(l.partial_cmp(u), Some(o) if o.is_le()))
    {
        return Err(SnapshotError::Value { name: "normaliser.lower".into(), index, value: lower[index] });
    }
    Ok(lower.into_iter().zip(upper).map(|(l, u)| [l, u]).collect())
}

fn read_f32(
    views: &[(String, TensorView<'_>)],
    name: &str,
    rank: usize,
) -> Result<(Vec<f32>, Vec<usize>), SnapshotError> {
    let view = find(views, name, Dtype::F32, rank)?;
    let values = view.data().as_chunks::<4>().0.iter().map(|c| f32::from_le_bytes(*c)).collect();
    Ok((checked(name, values)?, view.shape().to_vec()))
}

fn read_net(views: &[(String, TensorView<'_>)], prefix: &str) -> Result<(Dense, Vec<f32>), SnapshotError> {
    let mut layers = Vec::new();
    let count = views.iter().filter(|(n, _)| n.starts_with(prefix) && n.ends_with(".weight")).count();
    for i in 0..count.max(1) {
        let (weight, shape) = read_f32(views, &format!("{prefix}.{i}.weight"), 2)?;
        let (bias, bias_shape) = read_f32(views, &format!("{prefix}.{i}.bias"), 1)?;
        let n_in = layers.last().map_or(shape[1], |l: &crate::net::DenseLayer| l.n_out);
        if shape[1] != n_in || bias_shape[0] != shape[0] || shape[0] == 0 || n_in == 0 {
            return Err(SnapshotError::Shape {
                name: format!("{prefix}.{i}.weight"),
                expected: format!("[{}, {n_in}]", bias_shape[0]),
                actual: format!("{shape:?}"),
            });
        }
        layers.push(crate::net::DenseLayer { n_in, n_out: shape[0], weight, bias });
    }
    let mut net = Dense { layers, skip: None };
    let name = format!("{prefix}.skip");
    if views.iter().any(|(n, _)| *n == name) {
        let (weight, shape) = read_f32(views, &name, 2)?;
        if shape != [net.n_out(), net.n_in()] {
            return Err(SnapshotError::Shape {
                name,
                expected: format!("[{}, {}]", net.n_out(), net.n_in()),
                actual: format!("{shape:?}"),
            });
        }
        net.skip = Some(weight);
    }
    Ok((net, read_f32(views, &format!("{prefix}.log_std"), 1)?.0))
}
