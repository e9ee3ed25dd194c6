//! From the nodes of a file to a chain of operations.

use super::ImportError;
use super::chain::{Live, Operation};
use super::fold::{cast_to, fold};
use super::network::ImportedNetwork;
use super::tensor::{MOST, Tensor};
use nearl_runtime::net::Function;
use rten_onnx::onnx::{AttributeProto, DataType, GraphProto, NodeProto};
use std::collections::HashMap;
use std::path::Path;

/// What a name of the graph stands for.
#[derive(Clone)]
enum Value {
    Constant(Tensor),
    /// Depends on an input: number of its last operation.
    Live(usize),
    /// Cannot be read; only said if the action depends on it.
    Refused(ImportError),
}

/// Outputs that hold the action where a file has several.
const ACTIONS: [&str; 6] = ["actions", "action", "continuous_actions", "mu", "mean", "output"];

/// The values of a graph, node by node.
pub(super) struct Graph<'a> {
    values: HashMap<&'a str, Value>,
    lives: Vec<Live>,
    outputs: Vec<&'a str>,
    /// Elements that nodes of constants have made so far.
    folded: usize,
    beside: Option<&'a Path>,
}

impl<'a> Graph<'a> {
    /// Reads constants and inputs, then every node in order.
    pub(super) fn new(graph: &'a GraphProto, beside: Option<&'a Path>) -> Self {
        let outputs = graph.output.iter().filter_map(|o| o.name.as_deref()).collect();
        let mut this = Self { values: HashMap::new(), lives: Vec::new(), outputs, folded: 0, beside };
        for constant in &graph.initializer {
            let name = constant.name.as_deref().unwrap_or_default();
            let value = Tensor::read(constant, beside).map_or_else(
                |reason| Value::Refused(ImportError::Graph(format!("constant '{name}' {reason}"))),
                Value::Constant,
            );
            this.values.insert(name, value);
        }
        for input in &graph.input {
            let Some(name) = input.name.as_deref() else { continue };
            let shape =
                input.r#type.as_ref().and_then(|t| t.tensor_type.as_ref()).and_then(|t| t.shape.as_ref());
            let last = shape.and_then(|s| s.dim.last()).and_then(|d| d.dim_value);
            let width = last.and_then(|d| usize::try_from(d).ok()).filter(|&d| d > 0);
            if !this.values.contains_key(name) {
                let live = this.push(None, Operation::Input(name.into(), width), name, "input");
                this.values.insert(name, live);
            }
        }
        graph.node.iter().for_each(|node| this.node(node));
        this
    }

    /// The policy whose action is `output`, or the one output that can be it.
    pub(super) fn policy(self, output: Option<&str>) -> Result<ImportedNetwork, ImportError> {
        let names = || self.outputs.iter().map(|o| format!("'{o}'")).collect::<Vec<_>>().join(", ");
        let chosen = match (output, &self.outputs[..]) {
            (Some(name), all) => all.iter().copied().find(|o| *o == name).ok_or_else(|| {
                ImportError::Graph(format!("it has no output '{name}'; its outputs are {}", names()))
            })?,
            (None, [only]) => only,
            (None, all) => ACTIONS.iter().copied().find(|a| all.contains(a)).ok_or_else(|| {
                ImportError::Graph(format!(
                    "none of its outputs {} is called actions; name one with --output",
                    names()
                ))
            })?,
        };
        match self.values.get(chosen) {
            Some(Value::Live(last)) => ImportedNetwork::of_chain(&self.chain(*last), chosen),
            Some(Value::Refused(error)) => Err(error.clone()),
            Some(Value::Constant(_)) => {
                Err(ImportError::Graph(format!("its output '{chosen}' is a constant")))
            }
            None => Err(ImportError::Graph(format!("nothing computes its output '{chosen}'"))),
        }
    }

    /// From the input to operation `last`.
    fn chain(&self, last: usize) -> Vec<&Live> {
        let mut chain: Vec<&Live> =
            std::iter::successors(Some(last), |&i| self.lives[i].before).map(|i| &self.lives[i]).collect();
        chain.reverse();
        chain
    }

    fn push(&mut self, before: Option<usize>, operation: Operation, name: &str, op: &str) -> Value {
        self.lives.push(Live { before, operation, name: name.into(), op: op.into() });
        Value::Live(self.lives.len() - 1)
    }

    fn node(&mut self, node: &'a NodeProto) {
        let op = node.op_type.as_deref().unwrap_or_default();
        let first = node.output.first().map_or("", String::as_str);
        let name = node.name.as_deref().filter(|n| !n.is_empty()).unwrap_or(first);
        let wrong = |reason| ImportError::Node { name: name.into(), op: op.into(), reason };
        let inputs: Vec<Option<Value>> =
            node.input.iter().map(|i| self.values.get(i.as_str()).cloned()).collect();
        let refused = inputs.iter().flatten().find_map(|v| match v {
            Value::Refused(e) => Some(e.clone()),
            _ => None,
        });
        // An input that is left out has no name.
        let unknown =
            node.input.iter().zip(&inputs).find(|(name, value)| !name.is_empty() && value.is_none());
        let result = match (refused, unknown) {
            (Some(error), _) => Err(error),
            (_, Some((input, _))) => Err(wrong(format!("reads '{input}', which nothing before it computes"))),
            _ => self.evaluate(node, op, name, &inputs).map_err(wrong),
        };
        for (i, output) in node.output.iter().enumerate() {
            let value = match &result {
                Ok(values) => values.get(i).cloned().unwrap_or_else(|| {
                    Value::Refused(ImportError::Node {
                        name: name.into(),
                        op: op.into(),
                        reason: format!("has an output '{output}' that is not read"),
                    })
                }),
                Err(error) => Value::Refused(error.clone()),
            };
            self.values.insert(output, value);
        }
    }

    /// The node's outputs, or what is wrong with it.
    fn evaluate(
        &mut self,
        node: &NodeProto,
        op: &str,
        name: &str,
        inputs: &[Option<Value>],
    ) -> Result<Vec<Value>, String> {
        if node.domain.as_deref().is_some_and(|d| !d.is_empty() && d != "ai.onnx") {
            return Err("is not one of ONNX's own".into());
        }
        if op == "Constant" {
            let attribute = node.attribute.first().ok_or("has no value")?;
            return Ok(vec![Value::Constant(Tensor::of_attribute(attribute, self.beside)?)]);
        }
        match constants(inputs) {
            Some(all) => {
                let made = fold(&Node { node, op, at: 0, constant: &|i| all.get(i).copied().flatten() })?;
                self.folded += made.values.len();
                if self.folded > MOST {
                    return Err("makes more constants than any policy has".into());
                }
                Ok(vec![Value::Constant(made)])
            }
            None => self.operation(node, op, name, inputs),
        }
    }

    /// A node with an input that depends on the observation.
    fn operation(
        &mut self,
        node: &NodeProto,
        op: &str,
        name: &str,
        inputs: &[Option<Value>],
    ) -> Result<Vec<Value>, String> {
        if let ("Mul", [Some(Value::Live(a)), Some(Value::Live(b))]) = (op, inputs) {
            return self.swish(*a, *b, name).map(|v| vec![v]);
        }
        let mut lives = inputs.iter().enumerate().filter_map(|(at, value)| match value {
            Some(Value::Live(x)) => Some((at, *x)),
            _ => None,
        });
        let (at, x) = lives.next().ok_or("has no input that this program knows")?;
        if lives.next().is_some() {
            return Err("joins two values that both depend on the observation".into());
        }
        let last = match op {
            "Max" | "Min" => usize::MAX,
            "Add" | "Sub" | "Mul" | "Div" | "Gemm" | "MatMul" => 1,
            _ => 0,
        };
        if at > last {
            return Err(format!("takes its input {at} from the observation, where a constant is read"));
        }
        let constant = |i: usize| inputs.get(i).and_then(as_constant);
        let operations = operations(&Node { node, op, at, constant: &constant })?;
        Ok(operations.into_iter().map(|operation| self.push(Some(x), operation, name, op)).collect())
    }

    /// `x sigmoid(x)`, in either order.
    fn swish(&mut self, a: usize, b: usize, name: &str) -> Result<Value, String> {
        let of = |x: usize, s: usize| {
            matches!(self.lives[s].operation, Operation::Function(Function::Sigmoid))
                && self.lives[s].before == Some(x)
        };
        let x = match (of(a, b), of(b, a)) {
            (true, _) => a,
            (_, true) => b,
            _ => return Err("multiplies two values that both depend on the observation".into()),
        };
        Ok(self.push(Some(x), Operation::Function(Function::Silu), name, "Mul"))
    }
}

/// All inputs, each in its place, if none depends on the observation.
fn constants(inputs: &[Option<Value>]) -> Option<Vec<Option<&Tensor>>> {
    let of = |value: &'_ Option<Value>| !matches!(value, Some(Value::Live(_)));
    inputs.iter().all(of).then(|| inputs.iter().map(as_constant).collect())
}

fn as_constant(value: &Option<Value>) -> Option<&Tensor> {
    match value {
        Some(Value::Constant(tensor)) => Some(tensor),
        _ => None,
    }
}

/// A node with its constants; `at` is the place of the input that depends on the observation, if one does.
pub(super) struct Node<'a> {
    node: &'a NodeProto,
    pub(super) op: &'a str,
    at: usize,
    pub(super) constant: &'a dyn Fn(usize) -> Option<&'a Tensor>,
}

impl Node<'_> {
    fn attribute(&self, name: &str) -> Option<&AttributeProto> {
        self.node.attribute.iter().find(|a| a.name.as_deref() == Some(name))
    }
    fn float(&self, name: &str, default: f32) -> f64 {
        f64::from(self.attribute(name).and_then(|a| a.f).unwrap_or(default))
    }
    pub(super) fn integer(&self, name: &str, default: i64) -> i64 {
        self.attribute(name).and_then(|a| a.i).unwrap_or(default)
    }
    /// Input `i` as a constant row.
    fn row(&self, i: usize) -> Result<Vec<f64>, String> {
        let tensor = (self.constant)(i).ok_or("needs a constant for its other input")?;
        let row = tensor
            .row()
            .ok_or_else(|| format!("has a constant of shape {:?}, where one row is read", tensor.dims))?;
        Ok(row.to_vec())
    }
    /// How many inputs it has.
    pub(super) fn width(&self) -> usize {
        self.node.input.len()
    }

    /// The constants beside the input that depends on the observation, of a node that takes as many as one likes, reduced to one row.
    fn others(&self, reduce: fn(f64, f64) -> f64) -> Result<Vec<f64>, String> {
        let mut all = (0..self.width()).filter(|&i| i != self.at).map(|i| self.row(i).map(Tensor::vector));
        let first = all.next().ok_or("has one input")??;
        let fits = |a: &Tensor, b: &Tensor| a.zip(b, reduce).ok_or("has constants of shapes that do not fit");
        Ok(all.try_fold(first, |row, next| fits(&row, &next?).map_err(String::from))?.values)
    }

    /// Whole numbers from input `i`, else from the attribute.
    pub(super) fn integers(&self, i: usize, name: &str) -> Option<Vec<i64>> {
        let listed = || self.attribute(name).map(|a| a.ints.clone()).filter(|l| !l.is_empty());
        (self.constant)(i).map(Tensor::integers).or_else(listed)
    }
    /// A bound from input `i`, else from the attribute, else none.
    fn bound(&self, i: usize, name: &str, none: f64) -> Result<Vec<f64>, String> {
        match (self.constant)(i) {
            Some(_) => self.row(i),
            None => Ok(vec![self.attribute(name).and_then(|a| a.f).map_or(none, f64::from)]),
        }
    }
}

/// What the node does to the value that depends on the observation: one operation for each output.
fn operations(n: &Node<'_>) -> Result<Vec<Operation>, String> {
    let one = |operation| Ok(vec![operation]);
    let function = |f| one(Operation::Function(f));
    match n.op {
        "Identity" | "Flatten" | "Squeeze" | "Unsqueeze" => one(Operation::Same),
        "Dropout" if n.row(2).is_ok_and(|training| training != [0.0]) => {
            Err("drops entries, as in training; export the policy in eval mode".into())
        }
        "Dropout" => one(Operation::Same),
        "Cast" => {
            let kind = DataType(n.integer("to", 0) as i32);
            let keeps = [DataType::FLOAT, DataType::DOUBLE, DataType::FLOAT16, DataType::BFLOAT16];
            if keeps.contains(&kind) { one(Operation::Same) } else { Err(cast_to(kind)) }
        }
        "Reshape" => reshape(n),
        "Tanh" => function(Function::Tanh),
        "Relu" => function(Function::Relu),
        "Sigmoid" => function(Function::Sigmoid),
        "Softplus" => function(Function::Softplus),
        "Elu" | "Swish" => {
            let (alpha, f) =
                (n.float("alpha", 1.0), if n.op == "Elu" { Function::Elu } else { Function::Silu });
            if alpha == 1.0 { function(f) } else { Err(format!("has alpha = {alpha}, where 1 is known")) }
        }
        "Gemm" => gemm(n),
        "MatMul" => {
            if n.at != 0 {
                return Err("multiplies from the left".into());
            }
            let w = (n.constant)(1).ok_or("needs a constant matrix")?;
            dense(&w.transposed().ok_or("needs a constant matrix")?, None, 1.0, 1.0).map(|s| vec![s])
        }
        "Add" => one(Operation::Affine(vec![1.0], n.row(1 - n.at)?)),
        "Sub" if n.at == 0 => one(Operation::Affine(vec![1.0], n.row(1)?.iter().map(|x| -x).collect())),
        "Sub" => one(Operation::Affine(vec![-1.0], n.row(0)?)),
        "Mul" => one(Operation::Affine(n.row(1 - n.at)?, vec![0.0])),
        "Div" if n.at == 0 => one(Operation::Affine(n.row(1)?.iter().map(|x| 1.0 / x).collect(), vec![0.0])),
        "Neg" => one(Operation::Affine(vec![-1.0], vec![0.0])),
        "Clip" => {
            one(Operation::Clip(n.bound(1, "min", f64::NEG_INFINITY)?, n.bound(2, "max", f64::INFINITY)?))
        }
        "Max" | "Min" if n.width() == 1 => one(Operation::Same),
        "Max" => one(Operation::Clip(n.others(f64::max)?, vec![f64::INFINITY])),
        "Min" => one(Operation::Clip(vec![f64::NEG_INFINITY], n.others(f64::min)?)),
        "Split" => split(n),
        "Slice" => slice(n),
        _ => Err("is none that a policy's layers consist of (docs/POLICIES.md lists them; a policy of others proposes beside the loop)".into()),
    }
}

/// `alpha x W + beta c`.
fn gemm(n: &Node<'_>) -> Result<Vec<Operation>, String> {
    if n.at != 0 || n.integer("transA", 0) != 0 {
        return Err("multiplies from the left".into());
    }
    let w = (n.constant)(1).ok_or("needs a constant matrix")?;
    let w = if n.integer("transB", 0) == 0 { w.transposed() } else { w.matrix().map(|_| w.clone()) };
    let bias = (n.constant)(2).map(|_| n.row(2)).transpose()?;
    dense(&w.ok_or("needs a constant matrix")?, bias, n.float("alpha", 1.0), n.float("beta", 1.0))
        .map(|s| vec![s])
}

fn dense(w: &Tensor, bias: Option<Vec<f64>>, alpha: f64, beta: f64) -> Result<Operation, String> {
    let (n_out, n_in) = w.matrix().ok_or("needs a constant matrix")?;
    let bias = match bias {
        None => vec![0.0; n_out],
        Some(b) if b.len() == 1 => vec![beta * b[0]; n_out],
        Some(b) if b.len() == n_out => b.iter().map(|x| beta * x).collect(),
        Some(b) => return Err(format!("adds {} numbers to {n_out}", b.len())),
    };
    Ok(Operation::Dense { n_in, n_out, weight: w.values.iter().map(|x| alpha * x).collect(), bias })
}

/// A shape of one row is none of a policy's business; another one would mix what belongs to one entry.
fn reshape(n: &Node<'_>) -> Result<Vec<Operation>, String> {
    let shape = n.integers(1, "shape").ok_or("needs a constant shape")?;
    let rest = shape.split_last().map_or(&[][..], |(_, rest)| rest);
    if rest.iter().all(|&d| (-1..=1).contains(&d)) {
        let last = shape.last().and_then(|&last| usize::try_from(last).ok()).filter(|&last| last > 0);
        return Ok(vec![last.map_or(Operation::Same, Operation::Width)]);
    }
    Err(format!("makes the shape {shape:?}, where one row is read"))
}

/// The last axis, or the second of two.
fn is_last(axis: i64) -> bool {
    axis == -1 || axis == 1
}

fn split(n: &Node<'_>) -> Result<Vec<Operation>, String> {
    let axis = n.integer("axis", 0);
    if !is_last(axis) {
        return Err(format!("splits axis {axis}, where the last is read"));
    }
    let outputs = n.node.output.len();
    let Some(sizes) = n.integers(1, "split") else {
        // equal parts: their size is known once the width is
        return Ok((0..outputs).map(|i| Operation::Part(i, outputs)).collect());
    };
    let mut at = 0;
    let ranges = sizes.iter().map(|&size| {
        let start = at;
        at += usize::try_from(size).unwrap_or(0);
        Operation::Select(start..at)
    });
    Ok(ranges.collect())
}

fn slice(n: &Node<'_>) -> Result<Vec<Operation>, String> {
    let (starts, ends) = (n.integers(1, "starts"), n.integers(2, "ends"));
    let (Some(starts), Some(ends)) = (starts, ends) else { return Err("needs constant bounds".into()) };
    let axes = n.integers(3, "axes").unwrap_or_else(|| (0..starts.len() as i64).collect());
    let steps = (n.constant)(4).map(Tensor::integers).unwrap_or_default();
    if steps.iter().any(|&s| s != 1) {
        return Err(format!("takes every {steps:?}th entry, where neighbours are read"));
    }
    let mut range = None;
    for ((&axis, &start), &end) in axes.iter().zip(&starts).zip(&ends) {
        match (is_last(axis), axis, start) {
            (true, ..) => range = Some(Operation::Slice(start, end)),
            (_, 0, 0) if end >= 1 => {}
            _ => return Err(format!("cuts axis {axis}, where the last is read")),
        }
    }
    Ok(vec![range.unwrap_or(Operation::Same)])
}
