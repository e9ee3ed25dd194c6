//! `nearl tunnel`: the links of a robot, carried to a trainer on another host by iceoryx2's own tunnel over zenoh.
//!
//! Each robot has shared memory and files of its own name ([`RobotName`]), so the tunnel needs the configuration of the links.

use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::Duration;

use clap::{ArgGroup, Args};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::json;

use crate::cli::Failure;
use crate::link::{CROSSING, Crossing, RobotName};
use crate::stop::Stop;

/// iceoryx2's tunnel, a program of its own.
const PROGRAM: &str = "iox2-link-tunnel-zenoh";
const INSTALL: &str = "cargo install --locked --version 0.10.0 iceoryx2-integrations-zenoh-link-tunnel-cli";

/// Pause between two looks of the tunnel for messages [ms].
const POLL: &str = "1";

/// Carry the links of a robot to or from another host until a signal comes; needs iceoryx2's tunnel for zenoh.
#[derive(Args, Debug)]
#[command(group(ArgGroup::new("address").required(true).multiple(true).args(["listen", "connect"])))]
pub struct TunnelCommand {
    /// Name of the robot, the same on both hosts.
    pub name: String,
    /// Address on which this host waits for the other, for example `tcp/0.0.0.0:7447`.
    #[arg(long, value_parser = address)]
    pub listen: Option<String>,
    /// Address of the host that listens, for example `tcp/192.168.1.20:7447`.
    #[arg(long, value_parser = address)]
    pub connect: Option<String>,
    /// Folder for the tunnel's configuration; `tunnel/<name>` if not given.
    #[arg(long)]
    pub out: Option<PathBuf>,
}

impl TunnelCommand {
    /// Runs the tunnel until it ends or a signal comes.
    ///
    /// # Errors
    /// One sentence: the name, a file that could not be written, or the tunnel that is missing or gave up.
    pub fn run(self) -> Result<(), Failure> {
        let name = RobotName::new(&self.name)?;
        let folder = self.out.clone().unwrap_or_else(|| PathBuf::from("tunnel").join(name.as_str()));
        self.configure(&name, &folder)?;
        let _topics = Crossing::open(&name)?;
        let stop = Stop::on_signals()?;
        let mut command = Command::new(PROGRAM);
        command.current_dir(&folder).args(["--zenoh-config", "zenoh.json5", "--poll", POLL]);
        for topic in CROSSING {
            command.args(["--allow", &format!("nearl/{name}/{topic}")]);
        }
        let child = command
            .spawn()
            .map_err(|e| format!("{PROGRAM} could not be started ({e}): install it with `{INSTALL}`"))?;
        wait(child, &stop)
    }

    /// Writes the configuration of iceoryx2 and of zenoh.
    fn configure(&self, name: &RobotName, folder: &Path) -> Result<(), Failure> {
        let endpoints = |address: &Option<String>| json!({ "endpoints": address.iter().collect::<Vec<_>>() });
        let zenoh = json!({
            "mode": "peer",
            "listen": endpoints(&self.listen),
            "connect": endpoints(&self.connect),
            "scouting": { "multicast": { "enabled": false } },
        });
        let config = folder.join("config");
        let failed = |file: &Path, e: std::io::Error| {
            format!("{} cannot be written ({e}): choose another --out", file.display())
        };
        std::fs::create_dir_all(&config).map_err(|e| failed(&config, e))?;
        let files = [
            (config.join("iceoryx2.toml"), toml::to_string(&name.config()?)?),
            (folder.join("zenoh.json5"), serde_json::to_string_pretty(&zenoh)?),
        ];
        for (file, text) in files {
            std::fs::write(&file, text).map_err(|e| failed(&file, e))?;
        }
        Ok(())
    }
}

/// An address as zenoh writes it: the protocol, then host and port.
fn address(text: &str) -> Result<String, String> {
    let parts = text.split_once('/').and_then(|(protocol, place)| Some((protocol, place.rsplit_once(':')?)));
    let is_one = parts.is_some_and(|(protocol, (host, port))| {
        let is_protocol = ["tcp", "udp", "tls", "quic", "ws"].contains(&protocol);
        is_protocol
            && !host.is_empty()
            && !host.contains('/')
            && port.parse::<u16>().is_ok_and(|port| port > 0)
    });
    if is_one {
        Ok(text.into())
    } else {
        Err("give protocol, host and port as zenoh writes them: tcp/192.168.1.20:7447".into())
    }
}

fn wait(mut child: Child, stop: &Stop) -> Result<(), Failure> {
    loop {
        // Ctrl-C reaches the child too: that it has ended is then no failure.
        if stop.is_requested() {
            // Asked, not killed: it then removes its own files.
            if child.try_wait()?.is_none()
                && let Some(pid) = Pid::from_raw(child.id() as i32)
            {
                kill_process(pid, Signal::TERM)?;
            }
            child.wait()?;
            return Ok(());
        }
        if let Some(status) = child.try_wait()? {
            return Err(format!("{PROGRAM} ended ({status}): its own lines above say why").into());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_has_protocol_host_and_port() {
        for good in ["tcp/0.0.0.0:7447", "udp/robot.local:1", "tls/[::1]:7447"] {
            assert_eq!(address(good).unwrap(), good);
        }
        for bad in [
            "",
            "robot",
            "robot:7447",
            "tcp/robot",
            "tcp/:7447",
            "tcp/robot:0",
            "tcp/robot:99999",
            "http/robot:7447",
            "tcp/a/b:7",
        ] {
            assert!(address(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn the_tunnel_reads_the_configuration_of_the_links() {
        let folder = std::env::temp_dir().join(format!("nearl-tunnel-{}", std::process::id()));
        let command = TunnelCommand {
            name: "arm".into(),
            listen: None,
            connect: Some("tcp/10.0.0.1:7447".into()),
            out: None,
        };
        let name = RobotName::new("arm").unwrap();
        command.configure(&name, &folder).unwrap();
        let text = std::fs::read_to_string(folder.join("config/iceoryx2.toml")).unwrap();
        let read: iceoryx2::config::Config = toml::from_str(&text).unwrap();
        assert_eq!(read, name.config().unwrap());
        let zenoh = std::fs::read_to_string(folder.join("zenoh.json5")).unwrap();
        let zenoh: serde_json::Value = serde_json::from_str(&zenoh).unwrap();
        assert_eq!(zenoh["connect"]["endpoints"][0], "tcp/10.0.0.1:7447");
        assert_eq!(zenoh["listen"]["endpoints"].as_array().unwrap().len(), 0);
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
