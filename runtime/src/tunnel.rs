//! `nearl tunnel`: what iceoryx2's tunnel over zenoh needs to carry the links of a robot to a trainer on another host.
//!
//! Each robot has shared memory and files of its own name ([`RobotName`]), so the tunnel needs the same configuration as the
//! links. What crosses is what a trainer reads and writes; actions never leave the robot's host.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use crate::cli::{Failure, say};
use crate::link::{
    HealthMessage, Message, ReceiptMessage, RobotMessage, RobotName, SnapshotHeader, StateMessage,
    TransitionMessage,
};

/// Topics that cross; the action is not among them.
const TOPICS: [&str; 6] = [
    RobotMessage::TOPIC,
    StateMessage::TOPIC,
    TransitionMessage::TOPIC,
    HealthMessage::TOPIC,
    ReceiptMessage::TOPIC,
    SnapshotHeader::TOPIC,
];

/// Pause between two looks of the tunnel for messages [ms].
const POLL: u32 = 1;

/// Write the configuration of a tunnel to another host, and say how to start it.
#[derive(Args, Debug)]
pub struct TunnelCommand {
    /// Name of the robot.
    pub name: String,
    /// Address on which this host waits for the other, for example `tcp/0.0.0.0:7447`.
    #[arg(long, required_unless_present = "connect")]
    pub listen: Option<String>,
    /// Address of the host that listens, for example `tcp/192.168.1.20:7447`.
    #[arg(long)]
    pub connect: Option<String>,
    /// Folder for the configuration; `tunnel/<name>` if not given.
    #[arg(long)]
    pub out: Option<PathBuf>,
}

impl TunnelCommand {
    /// Writes the files and prints the command.
    ///
    /// # Errors
    /// One sentence: the name, or the file that could not be written.
    pub fn run(self) -> Result<(), Failure> {
        let name = RobotName::new(&self.name)?;
        let folder = self.out.unwrap_or_else(|| PathBuf::from("tunnel").join(name.as_str()));
        let endpoints = |address: &Option<String>| json!({ "endpoints": address.iter().collect::<Vec<_>>() });
        let zenoh = json!({
            "mode": "peer",
            "listen": endpoints(&self.listen),
            "connect": endpoints(&self.connect),
            "scouting": { "multicast": { "enabled": false } },
        });
        let config = folder.join("config");
        let write = |file: PathBuf, text: String| {
            std::fs::write(&file, text)
                .map_err(|e| format!("{} cannot be written ({e}): choose another --out", file.display()))
        };
        std::fs::create_dir_all(&config)
            .map_err(|e| format!("{} cannot be made ({e}): choose another --out", config.display()))?;
        write(config.join("iceoryx2.toml"), toml::to_string(&name.config()?)?)?;
        write(folder.join("zenoh.json5"), serde_json::to_string_pretty(&zenoh)?)?;
        let allowed = TOPICS.map(|topic| format!(" --allow nearl/{name}/{topic}")).concat();
        say(format!(
            "cd {} && iox2-link-tunnel-zenoh --zenoh-config zenoh.json5 --poll {POLL}{allowed}",
            folder.display()
        ));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tunnel_reads_the_configuration_of_the_links() {
        let folder = std::env::temp_dir().join(format!("nearl-tunnel-{}", std::process::id()));
        let command = TunnelCommand {
            name: "arm".into(),
            listen: None,
            connect: Some("tcp/10.0.0.1:7447".into()),
            out: Some(folder.clone()),
        };
        command.run().unwrap();
        let text = std::fs::read_to_string(folder.join("config/iceoryx2.toml")).unwrap();
        let read: iceoryx2::config::Config = toml::from_str(&text).unwrap();
        assert_eq!(read, RobotName::new("arm").unwrap().config().unwrap());
        let zenoh = std::fs::read_to_string(folder.join("zenoh.json5")).unwrap();
        let zenoh: serde_json::Value = serde_json::from_str(&zenoh).unwrap();
        assert_eq!(zenoh["connect"]["endpoints"][0], "tcp/10.0.0.1:7447");
        assert_eq!(zenoh["listen"]["endpoints"].as_array().unwrap().len(), 0);
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
