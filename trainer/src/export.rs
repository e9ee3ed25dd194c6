//! A snapshot's policy as an ONNX file: the normaliser inside, and the metadata that mjlab writes.
//!
//! ```text
//!     obs -> Sub mean -> Div std -> clip -> Gemm, function, ... -> clip -> actions       a policy of actions, before scale and offset
//!                                                              -> Mul scale -> change    a policy that proposes: proposal = s + change
//!                                                              -> Mul scale -> state     the same of an imported one that puts out the proposal
//! ```

use crate::import::metadata::RECIPE;
use nearl_runtime::constraints::Drive;
use nearl_runtime::motors::Motors;
use nearl_runtime::net::Function;
use nearl_runtime::normaliser::CLIP;
use nearl_runtime::recipe::{ActionSection, Numbers, PolicySection};
use nearl_runtime::{Controller, PolicyKind, Snapshot, SnapshotError, Task};
use rten_onnx::onnx::{
    AttributeProto, AttributeType, DataType, Dimension, GraphProto, ModelProto, NodeProto,
    OperatorSetIdProto, StringStringEntryProto, TensorProto, TensorShapeProto, TypeProto, TypeProtoTensor,
    ValueInfoProto,
};
use std::cell::RefCell;

/// Name of the output: `actions`, `change` or `state`.
pub fn output(snapshot: &Snapshot) -> &'static str {
    match snapshot.manifest.policy {
        PolicyKind::Direct => "actions",
        PolicyKind::Deterministic | PolicyKind::Stochastic => "change",
        PolicyKind::State => "state",
    }
}

/// The bytes of the ONNX file (opset 13, float32), one sample a call.
///
/// # Errors
/// [`SnapshotError`] where no controller can be built of the snapshot.
pub fn onnx(snapshot: &Snapshot) -> Result<Vec<u8>, SnapshotError> {
    let controller = Controller::new(snapshot)?;
    let mut graph = Graph::default();
    let norm = &snapshot.networks.normaliser;
    graph.row("Sub", "mean", &norm.mean);
    graph.row("Div", "std", &norm.std);
    let clip = if norm.clip.is_empty() { vec![[-CLIP, CLIP]; norm.mean.len()] } else { norm.clip.clone() };
    graph.clip("input", &clip);
    let (layers, x) = (&snapshot.networks.policy.layers, graph.value.clone());
    let functions = snapshot.manifest.policy_functions(layers.len());
    for (i, (layer, function)) in layers.iter().zip(functions).enumerate() {
        let weight = graph.constant(&format!("policy.{i}.weight"), &[layer.n_out, layer.n_in], &layer.weight);
        let bias = graph.constant(&format!("policy.{i}.bias"), &[layer.n_out], &layer.bias);
        graph.node("Gemm", &[&weight, &bias], vec![integer("transB", 1)]);
        graph.function(function);
    }
    if let (Some(skip), Some(last)) = (&snapshot.networks.policy.skip, layers.last()) {
        // the linear map beside the layers: y + S x
        let weight = graph.constant("policy.skip.weight", &[last.n_out, norm.mean.len()], skip);
        graph.node("Identity", &[], Vec::new());
        let y = std::mem::replace(&mut graph.value, x);
        graph.node("Gemm", &[&weight, &y], vec![integer("transB", 1)]);
    }
    if snapshot.manifest.policy != PolicyKind::Direct {
        graph.row("Mul", "scale", &norm.scale);
    } else if let Some([lower, upper]) =
        snapshot.manifest.task.policy.as_ref().and_then(|p| p.action.clip.clone())
    {
        let n = snapshot.networks.policy.n_out();
        let side = |x: Numbers| x.spread("clip", n).unwrap_or_default();
        let clip: Vec<[f64; 2]> = side(lower).into_iter().zip(side(upper)).map(|(l, u)| [l, u]).collect();
        graph.clip("output", &clip);
    }
    let (n_in, n_out) = (norm.mean.len(), snapshot.networks.policy.n_out());
    let model = ModelProto {
        ir_version: Some(8),
        graph: Some(graph.finish(n_in, n_out, output(snapshot))),
        opset_import: vec![OperatorSetIdProto { domain: Some(String::new()), version: Some(13) }],
        metadata_props: metadata(snapshot, &controller),
        producer_name: Some("nearl".into()),
        producer_version: Some(env!("CARGO_PKG_VERSION").into()),
    };
    // the writer fails where its buffer does, and this one is memory
    Ok(named(model.write_buf().unwrap_or_else(|e| unreachable!("ONNX: {e}"))))
}

/// Gives the graph a name, which ONNX asks for and the writer has no field for: a graph of a name alone, which readers merge with the one that
/// follows, behind the version of the format (two bytes).
fn named(mut bytes: Vec<u8>) -> Vec<u8> {
    const NAME: &[u8] = b"policy";
    let n = NAME.len() as u8;
    let graph = [&[0x3a, n + 2, 0x12, n], NAME].concat();
    bytes.splice(2..2, graph);
    bytes
}

fn integer(name: &str, value: i64) -> AttributeProto {
    AttributeProto {
        name: Some(name.into()),
        i: Some(value),
        r#type: Some(AttributeType::INT),
        ..AttributeProto::default()
    }
}

/// A graph that is one line of nodes.
struct Graph {
    nodes: Vec<NodeProto>,
    constants: Vec<TensorProto>,
    /// Name of the newest value.
    value: String,
}

impl Default for Graph {
    fn default() -> Self {
        Self { nodes: Vec::new(), constants: Vec::new(), value: "obs".into() }
    }
}

impl Graph {
    fn constant(&mut self, name: &str, dims: &[usize], values: &[f32]) -> String {
        self.constants.push(TensorProto {
            dims: dims.iter().map(|&d| d as i64).collect(),
            data_type: Some(DataType::FLOAT),
            raw_data: Some(RefCell::new(values.iter().flat_map(|x| x.to_le_bytes()).collect())),
            name: Some(name.into()),
            ..TensorProto::default()
        });
        name.into()
    }

    /// A node of the newest value and constants.
    fn node(&mut self, op: &str, constants: &[&str], attribute: Vec<AttributeProto>) {
        let value = format!("{}_{}", op.to_lowercase(), self.nodes.len());
        let input =
            std::iter::once(self.value.as_str()).chain(constants.iter().copied()).map(Into::into).collect();
        self.nodes.push(NodeProto {
            domain: None,
            name: Some(value.clone()),
            input,
            output: vec![value.clone()],
            op_type: Some(op.into()),
            attribute,
        });
        self.value = value;
    }

    fn row(&mut self, op: &str, name: &str, values: &[f64]) {
        let values: Vec<f32> = values.iter().map(|&x| x as f32).collect();
        let name = self.constant(name, &[1, values.len()], &values);
        self.node(op, &[&name], Vec::new());
    }

    fn clip(&mut self, what: &str, clip: &[[f64; 2]]) {
        for (side, op) in [(0, "Max"), (1, "Min")] {
            if clip.iter().any(|c| c[side].is_finite()) {
                let values: Vec<f64> = clip.iter().map(|c| c[side]).collect();
                self.row(op, &format!("{what}_{}", if side == 0 { "lower" } else { "upper" }), &values);
            }
        }
    }

    fn function(&mut self, function: Function) {
        match function {
            Function::Identity => {}
            Function::Silu => {
                let x = self.value.clone();
                self.node("Sigmoid", &[], Vec::new());
                self.node("Mul", &[&x], Vec::new());
            }
            Function::Tanh => self.node("Tanh", &[], Vec::new()),
            Function::Relu => self.node("Relu", &[], Vec::new()),
            Function::Elu => self.node("Elu", &[], Vec::new()),
            Function::Softplus => self.node("Softplus", &[], Vec::new()),
            Function::Sigmoid => self.node("Sigmoid", &[], Vec::new()),
        }
    }

    fn finish(mut self, n_in: usize, n_out: usize, output: &str) -> GraphProto {
        if let Some(last) = self.nodes.last_mut() {
            last.output = vec![output.into()];
        }
        let value = |name: &str, n: usize| ValueInfoProto {
            name: Some(name.into()),
            r#type: Some(TypeProto {
                tensor_type: Some(TypeProtoTensor {
                    elem_type: Some(DataType::FLOAT),
                    shape: Some(TensorShapeProto {
                        dim: [1, n].map(|d| Dimension { dim_value: Some(d as i64), dim_param: None }).into(),
                    }),
                }),
                sequence: None,
            }),
        };
        GraphProto {
            node: self.nodes,
            initializer: self.constants,
            input: vec![value("obs", n_in)],
            output: vec![value(output, n_out)],
            value_info: Vec::new(),
        }
    }
}

/// mjlab's keys where the policy has a recipe, and the recipe itself for `nearl import`; none of a policy of actions whose motors no recipe can
/// describe, because several drive a joint or their torque is not linear in what they are sent.
fn metadata(snapshot: &Snapshot, controller: &Controller) -> Vec<StringStringEntryProto> {
    let task = &snapshot.manifest.task;
    let acts = snapshot.manifest.policy == PolicyKind::Direct;
    let mut pairs = vec![("task", task.name.clone())];
    let section = task
        .policy
        .clone()
        .or_else(|| if acts { of_motors(task, controller) } else { of_joints(controller) });
    let terms: Vec<String> = match section.as_ref().map_or(&[][..], |s| &s.observation) {
        [] => task.state.observation.clone(),
        terms => terms.iter().map(|t| t.term.name().to_string()).collect(),
    };
    pairs.push(("observation_names", terms.join(",")));
    let numbers = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(",");
    if let Some(section) = section {
        pairs.push(("joint_names", section.joints.join(",")));
        if !section.pose.is_empty() {
            pairs.push(("default_joint_pos", numbers(&section.pose)));
        }
        if acts {
            let scale = section.action.scale.spread("scale", section.joints.len()).unwrap_or_default();
            pairs.push(("action_scale", numbers(&scale)));
            if let Some([stiffness, damping]) = gains(snapshot, &section.joints, controller) {
                pairs.push(("joint_stiffness", numbers(&stiffness)));
                pairs.push(("joint_damping", numbers(&damping)));
            }
            pairs.push((RECIPE, recipe(snapshot, section)));
        }
    }
    let entry =
        |(key, value): (&str, String)| StringStringEntryProto { key: Some(key.into()), value: Some(value) };
    pairs.into_iter().map(entry).collect()
}

/// The joints that are proposed.
fn of_joints(controller: &Controller) -> Option<PolicySection> {
    let joints =
        controller.layout().controllable().iter().map(|&dof| controller.model().dof_name(dof)).collect();
    Some(PolicySection { joints, ..PolicySection::default() })
}

/// The recipe of a policy whose outputs are what the motors are sent: joints in the order of their motors, and the command that an output is.
fn of_motors(task: &Task, controller: &Controller) -> Option<PolicySection> {
    let (model, layout) = (controller.model(), controller.layout());
    let dofs = layout.controllable();
    let drives = task.command.drives(model, dofs).ok()?;
    let motors = Motors::new(model, dofs, &drives).ok()?;
    let mut order: Vec<usize> = (0..dofs.len()).collect();
    order.sort_by_key(|&k| motors.place(k));
    let offset = |&k: &usize| motors.command(k, 0.0);
    let scale = |k: &usize| motors.command(*k, 1.0) - offset(k);
    let action = ActionSection {
        scale: Numbers::Each(order.iter().map(scale).collect()),
        offset: Some(Numbers::Each(order.iter().map(offset).collect())),
        clip: None,
    };
    let joints = order.iter().map(|&k| model.dof_name(dofs[k])).collect();
    Some(PolicySection { joints, action, ..PolicySection::default() })
}

/// Stiffness and damping of the joints' drives, where all have one.
fn gains(snapshot: &Snapshot, joints: &[String], controller: &Controller) -> Option<[Vec<f64>; 2]> {
    let (model, layout) = (controller.model(), controller.layout());
    let drives = snapshot.manifest.task.command.drives(model, layout.controllable()).ok()?;
    let of = |name: &String| match drives[model.joint(name).ok()?.idx_v] {
        Drive::Pd { stiffness, damping } => Some((stiffness, damping)),
        _ => None,
    };
    let both: Vec<(f64, f64)> = joints.iter().map(of).collect::<Option<_>>()?;
    Some([both.iter().map(|g| g.0).collect(), both.iter().map(|g| g.1).collect()])
}

/// The task file without what follows from the robot file.
fn recipe(snapshot: &Snapshot, section: PolicySection) -> String {
    let mut task = snapshot.manifest.task.clone();
    task.policy = Some(section);
    let mut table: toml::Table = toml::from_str(&crate::run_folder::to_toml(&task)).unwrap_or_default();
    for key in ["env", "reward", "cost", "termination", "reset", "train"] {
        table.remove(key);
    }
    if let Some(time) = table.get_mut("time").and_then(toml::Value::as_table_mut) {
        time.remove("max_episode_steps"); // of the environment
    }
    if let Some(model) = table.get_mut("model").and_then(toml::Value::as_table_mut) {
        model.remove("urdf");
        model.remove("mjcf");
    }
    table.to_string()
}
