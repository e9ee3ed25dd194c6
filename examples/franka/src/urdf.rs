//! What the robot says of itself: its URDF, and the tool that it knows of.

use crate::{Failure, N};
use franka::{Robot, RobotState};

/// The names of its joints, from the base on.
pub(crate) fn joints(robot: &Robot) -> Result<Vec<String>, Failure> {
    named(&robot.robot_model()?)
}

fn named(urdf: &str) -> Result<Vec<String>, Failure> {
    let file = roxmltree::Document::parse(urdf)?;
    let turning = file
        .descendants()
        .filter(|node| node.has_tag_name("joint") && node.attribute("type") == Some("revolute"));
    let names: Vec<String> = turning.filter_map(|node| node.attribute("name")).map(String::from).collect();
    if names.len() != N {
        return Err(format!(
            "the robot's URDF has {} revolute joints, and an arm has {N}: {}",
            names.len(),
            names.join(", ")
        )
        .into());
    }
    Ok(names)
}

/// Its URDF, with mass, centre and inertia of tool and load at the flange, as its state gives them.
pub(crate) fn with_tool(robot: &Robot) -> Result<String, Failure> {
    added(&robot.robot_model()?, &robot.read_once()?)
}

fn added(urdf: &str, state: &RobotState) -> Result<String, Failure> {
    let file = roxmltree::Document::parse(urdf)?;
    let mut links =
        file.descendants().filter(|node| node.has_tag_name("link")).filter_map(|node| node.attribute("name"));
    let flange =
        links.find(|name| name.ends_with("link8")).ok_or("the robot's URDF has no link8, its flange")?;
    let end = urdf.rfind("</robot>").ok_or("the robot's URDF has no end")?;
    if state.m_total <= 0.0 {
        return Ok(urdf.into());
    }
    let ([x, y, z], i) = (state.F_x_Ctotal, state.I_total);
    let tool = format!(
        "  <link name=\"tool\">\n    <inertial>\n      <origin xyz=\"{x} {y} {z}\" rpy=\"0 0 0\"/>\n      <mass value=\"{}\"/>\n      \
         <inertia ixx=\"{}\" ixy=\"{}\" ixz=\"{}\" iyy=\"{}\" iyz=\"{}\" izz=\"{}\"/>\n    </inertial>\n  </link>\n  \
         <joint name=\"tool_joint\" type=\"fixed\">\n    <parent link=\"{flange}\"/>\n    <child link=\"tool\"/>\n  </joint>\n",
        state.m_total, i[0], i[3], i[6], i[4], i[7], i[8],
    );
    Ok(format!("{}{tool}{}", &urdf[..end], &urdf[end..]))
}
