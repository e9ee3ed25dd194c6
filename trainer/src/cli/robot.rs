//! `nearl robot`: joints, limits, motors and frames of a robot file.

use std::path::PathBuf;

use clap::Args;
use nearl_runtime::constraints::Model;
use nearl_runtime::constraints::description::{JointKind, Range, RobotDescription};

use super::{Failure, say};
use crate::robot;

#[derive(Args)]
pub(super) struct RobotCommand {
    /// URDF or MJCF file.
    file: PathBuf,
    /// The base of a URDF floats.
    #[arg(long)]
    free_flyer: bool,
    /// Print the whole description as JSON.
    #[arg(long)]
    json: bool,
}

impl RobotCommand {
    pub(super) fn run(self) -> Result<(), Failure> {
        let description = robot::read(&self.file, self.free_flyer)?;
        let model = Model::from_description(description.clone())?;
        if self.json {
            say(serde_json::to_string(&description)?);
            return Ok(());
        }
        let (bodies, nq, nv) = (description.bodies.len(), model.nq(), model.nv());
        let endless = description.joints().filter(|joint| joint.kind == JointKind::Continuous).count();
        let simulated = match endless {
            0 => String::new(),
            n => format!(
                " ({} in a task with [reward] or [scene], where a continuous joint is one angle)",
                nq - n
            ),
        };
        say(format!(
            "{}: {bodies} bodies, nq {nq}{simulated}, nv {nv}, {:.4} kg move",
            description.name,
            model.total_mass()
        ));
        joints(&description, &model);
        motors(&description);
        frames(&model);
        let left = robot::simulated_alone(&self.file)?;
        description.notes.iter().chain(&left).for_each(|note| say(format!("note: {note}")));
        Ok(())
    }
}

fn joints(description: &RobotDescription, model: &Model) {
    for (joint, at) in description.joints().zip(model.joints()) {
        let range = match joint.range {
            Range::Limited(lower, upper) => format!("{lower:.4} .. {upper:.4}"),
            Range::Unlimited => "no limits".to_string(),
            Range::NotStated => "limits not stated".to_string(),
        };
        let (velocity, effort) = (model.velocity_limit()[at.idx_v], model.effort_limit()[at.idx_v]);
        let kind = format!("{:?}", joint.kind).to_lowercase();
        say(format!("joint {:<24} {kind:<11}{range}, velocity {velocity}, effort {effort}", joint.name));
    }
}

/// Names that frame limits and the places of a task's expressions (`x.NAME`) take, in lines of a width that is read.
fn frames(model: &Model) {
    let mut line = String::from("frames");
    for name in model.frame_names().filter(|name| !name.is_empty()) {
        if line.chars().count() + name.chars().count() > 150 {
            say(std::mem::replace(&mut line, "frames".into()));
        }
        line += " ";
        line += name;
    }
    say(line);
}

fn motors(description: &RobotDescription) {
    if description.motors.is_empty() {
        say("motors: none, so that nothing drives a joint (an MJCF has them under <actuator>)");
    }
    for motor in &description.motors {
        let command = format!("{:?}", motor.command).to_lowercase();
        let law = match &motor.not_modelled {
            Some(reason) => format!("has {reason}: no torque can be turned into its control"),
            None => format!("gear {}, gain {}, bias {:?}", motor.gear, motor.gain, motor.bias),
        };
        say(format!(
            "motor {:<24} {command:<11}control {} of joint {}, {law}",
            motor.name, motor.order, motor.joint
        ));
    }
}
