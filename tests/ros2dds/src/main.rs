//! Runs zenoh-plugin-ros2dds until it is killed.
//!
//! Upstream's `zenoh-bridge-ros2dds` is not in the Rust registry, but the plugin that does its work
//! is. This program takes the four options of `zenoh-bridge-ros2dds` that `deploy/ros2` names, with
//! the same meaning: `-c FILE`, `-e ENDPOINT`, `-n /NAMESPACE` and `-d DOMAIN`. The options win over
//! the file.

use std::{env, future, process::exit};

use zenoh::{
    internal::{plugins::PluginsManager, runtime::RuntimeBuilder},
    Config, Result,
};
use zenoh_plugin_ros2dds::ROS2Plugin;

/// Returns the configuration that the command line asks for.
fn configured() -> Result<Config> {
    let mut options: Vec<(String, String)> = Vec::new();
    let mut words = env::args().skip(1);
    while let Some(option) = words.next() {
        let value = words.next().ok_or(format!("{option} needs a value"))?;
        options.push((option, value));
    }
    let file = options.iter().find(|(option, _)| option == "-c");
    let mut config = match file {
        Some((_, path)) => Config::from_file(path)?,
        None => Config::default(),
    };
    for (option, value) in &options {
        match option.as_str() {
            "-c" => {}
            "-e" => config.insert_json5("connect/endpoints", &format!("[{value:?}]"))?,
            "-n" => config.insert_json5("plugins/ros2dds/namespace", &format!("{value:?}"))?,
            "-d" => config.insert_json5("plugins/ros2dds/domain", value)?,
            _ => return Err(format!("unknown option {option}").into()),
        }
    }
    // The plugin keeps samples for late subscribers by their times, and shows its routes to queries.
    config.insert_json5("timestamping/enabled", "true")?;
    config.insert_json5("adminspace/enabled", "true")?;
    config.insert_json5("plugins_loading/enabled", "true")?;
    Ok(config)
}

/// Starts Zenoh with the plugin, and never returns unless one of them cannot start.
async fn run() -> Result<()> {
    let mut plugins = PluginsManager::static_plugins_only();
    plugins.declare_static_plugin::<ROS2Plugin, _>("ros2dds", true);
    let mut runtime = RuntimeBuilder::new(configured()?)
        .plugins_manager(plugins)
        .build()
        .await?;
    runtime.start().await?;
    future::pending().await
}

fn main() {
    zenoh::init_log_from_env_or("z=info");
    let tasks = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .expect("the threads of the tasks start");
    if let Err(error) = tasks.block_on(run()) {
        eprintln!("ros2dds: {error}");
        exit(1);
    }
}
