//! From a chain of operations to a normaliser and layers.

use super::ImportError;
use super::chain::{Live, Operation};
use super::elementwise::{Elementwise, of};
use nearl_runtime::net::{Dense, DenseLayer, Function};
use std::collections::BTreeMap;

/// The networks of a policy made elsewhere: `raw = clip(net(clip((obs - mean) / std)))`.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportedNetwork {
    /// Mean of each observation entry (n_obs).
    pub mean: Vec<f64>,
    /// Standard deviation of each observation entry (n_obs), positive.
    pub std: Vec<f64>,
    /// Clip of each network input (n_obs), possibly infinite.
    pub clip: Vec<[f64; 2]>,
    /// Layers.
    pub dense: Dense,
    /// What follows each layer.
    pub functions: Vec<Function>,
    /// Clip of each output (n_act), possibly infinite.
    pub output: Vec<[f64; 2]>,
    /// Name of the input in the file.
    pub input_name: String,
    /// Name of the output in the file.
    pub output_name: String,
    /// The file's metadata.
    pub metadata: BTreeMap<String, String>,
}

/// One layer in f64 while it is put together.
struct Layer {
    n_in: usize,
    weight: Vec<f64>,
    bias: Vec<f64>,
    function: Function,
}

impl Layer {
    /// `scale_i x_i + shift_i` alone.
    fn diagonal(n: usize) -> Self {
        let weight = (0..n * n).map(|i| if i / n == i % n { 1.0 } else { 0.0 }).collect();
        Self { n_in: n, weight, bias: vec![0.0; n], function: Function::Identity }
    }

    fn select(&mut self, range: std::ops::Range<usize>) {
        self.weight = self.weight[range.start * self.n_in..range.end * self.n_in].to_vec();
        self.bias = self.bias[range].to_vec();
    }
}

/// What has been put together so far.
struct Build {
    /// Before the first layer.
    head: Elementwise,
    layers: Vec<Layer>,
    /// Clip after the last layer.
    tail: Elementwise,
}

impl ImportedNetwork {
    /// Inputs.
    pub fn n_in(&self) -> usize {
        self.dense.n_in()
    }

    /// Outputs.
    pub fn n_out(&self) -> usize {
        self.dense.n_out()
    }

    pub(super) fn of_chain(chain: &[&Live], output: &str) -> Result<Self, ImportError> {
        let Some(Operation::Input(input, said)) = chain.first().map(|live| &live.operation) else {
            return Err(ImportError::Graph(format!("its output '{output}' does not come from an input")));
        };
        let first = chain.iter().find_map(|live| match live.operation {
            Operation::Dense { n_in, .. } => Some(n_in),
            _ => None,
        });
        let n = first
            .ok_or_else(|| ImportError::Graph("it has no layer (Gemm or MatMul) with weights".into()))?;
        if said.is_some_and(|said| said != n) {
            let said = said.unwrap_or_default();
            return Err(ImportError::Graph(format!(
                "its input '{input}' is {said} wide and its first layer {n}"
            )));
        }
        let mut build =
            Build { head: Elementwise::identity(n), layers: Vec::new(), tail: Elementwise::identity(0) };
        for live in &chain[1..] {
            build.take(&live.operation).map_err(|reason| ImportError::Node {
                name: live.name.clone(),
                op: live.op.clone(),
                reason,
            })?;
        }
        Ok(build.finish(input, output))
    }
}

impl Build {
    fn width(&self) -> usize {
        self.layers.last().map_or(self.head.a.len(), |l| l.bias.len())
    }

    fn take(&mut self, operation: &Operation) -> Result<(), String> {
        let n = self.width();
        let fits = |row: &[f64]| {
            if row.len() == 1 || row.len() == n {
                Ok(())
            } else {
                Err(format!("has {} numbers for {n} entries", row.len()))
            }
        };
        match operation {
            Operation::Input(..) | Operation::Same => Ok(()),
            Operation::Width(width) if *width == n => Ok(()),
            Operation::Width(width) => Err(format!("makes rows of {width} of the {n} entries that come")),
            Operation::Dense { n_in, n_out, weight, bias } => self.dense(*n_in, *n_out, weight, bias),
            Operation::Affine(scale, shift) => {
                fits(scale).and(fits(shift)).map(|()| self.affine(scale, shift))
            }
            Operation::Clip(lower, upper) => {
                fits(lower).and(fits(upper))?;
                let end = if self.layers.is_empty() { &mut self.head } else { &mut self.tail };
                end.clip(lower, upper);
                Ok(())
            }
            Operation::Function(function) => self.function(*function),
            Operation::Select(_) | Operation::Part(..) | Operation::Slice(..) => {
                let range = operation.range(n).filter(|r| r.start < r.end && r.end <= n);
                let range =
                    range.ok_or_else(|| format!("takes entries that the {n} before it do not have"))?;
                self.select(range)
            }
        }
    }

    fn dense(&mut self, n_in: usize, n_out: usize, weight: &[f64], bias: &[f64]) -> Result<(), String> {
        if n_in != self.width() {
            return Err(format!("takes {n_in} entries where {} come", self.width()));
        }
        if n_out == 0 || n_in == 0 {
            return Err("has no entries".into());
        }
        self.no_clip()?;
        let (weight, bias) = (weight.to_vec(), bias.to_vec());
        self.layers.push(Layer { n_in, weight, bias, function: Function::Identity });
        self.tail = Elementwise::identity(n_out);
        Ok(())
    }

    fn no_clip(&self) -> Result<(), String> {
        if self.tail.clips() { Err("follows a clip between two layers".into()) } else { Ok(()) }
    }

    fn affine(&mut self, scale: &[f64], shift: &[f64]) {
        let Some(last) = self.layers.last() else { return self.head.affine(scale, shift) };
        if last.function != Function::Identity {
            self.layers.push(Layer::diagonal(last.bias.len()));
        }
        let Some(last) = self.layers.last_mut() else { return };
        for (i, bias) in last.bias.iter_mut().enumerate() {
            *bias = of(scale, i) * *bias + of(shift, i);
            last.weight[i * last.n_in..][..last.n_in].iter_mut().for_each(|w| *w *= of(scale, i));
        }
        // what was clipped is now clipped elsewhere; the scaling itself happened above
        self.tail.affine(scale, shift);
    }

    fn function(&mut self, function: Function) -> Result<(), String> {
        self.no_clip()?;
        let last = self.layers.last_mut().ok_or("stands before the first layer")?;
        if last.function == Function::Identity {
            last.function = function;
        } else {
            let n = last.bias.len();
            self.layers.push(Layer { function, ..Layer::diagonal(n) });
        }
        Ok(())
    }

    fn select(&mut self, range: std::ops::Range<usize>) -> Result<(), String> {
        let last = self.layers.last_mut().ok_or("chooses among the entries of the observation")?;
        last.select(range.clone());
        let Elementwise { a, b, lower, upper } = &mut self.tail;
        for row in [a, b, lower, upper] {
            *row = row[range.clone()].to_vec();
        }
        Ok(())
    }

    /// `clip(a x + b)` before the first layer is `clip((x - mean) / std)`; a sign, and what does not depend on the entry, go into the layer.
    fn finish(mut self, input: &str, output: &str) -> ImportedNetwork {
        let n = self.head.a.len();
        let (mut mean, mut std, mut clip) =
            (vec![0.0; n], vec![1.0; n], vec![[f64::NEG_INFINITY, f64::INFINITY]; n]);
        let first = &mut self.layers[0];
        for k in 0..n {
            let (a, b) = (self.head.a[k], self.head.b[k]);
            let (lower, upper) = (self.head.lower[k], self.head.upper[k]);
            if a == 0.0 {
                let constant = b.max(lower).min(upper);
                for (i, bias) in first.bias.iter_mut().enumerate() {
                    *bias += constant * std::mem::take(&mut first.weight[i * n + k]);
                }
                continue;
            }
            (mean[k], std[k]) = (-b / a, 1.0 / a.abs());
            clip[k] = if a > 0.0 { [lower, upper] } else { [-upper, -lower] };
            if a < 0.0 {
                (0..first.bias.len()).for_each(|i| first.weight[i * n + k] *= -1.0);
            }
        }
        let functions = self.layers.iter().map(|l| l.function).collect();
        let f32s = |values: &[f64]| values.iter().map(|&x| x as f32).collect::<Vec<f32>>();
        let layers = self.layers.iter().map(|l| DenseLayer {
            n_in: l.n_in,
            n_out: l.bias.len(),
            weight: f32s(&l.weight),
            bias: f32s(&l.bias),
        });
        ImportedNetwork {
            dense: Dense { layers: layers.collect(), skip: None },
            functions,
            output: self.tail.lower.iter().zip(&self.tail.upper).map(|(&l, &u)| [l, u]).collect(),
            mean,
            std,
            clip,
            input_name: input.into(),
            output_name: output.into(),
            metadata: BTreeMap::new(),
        }
    }
}
