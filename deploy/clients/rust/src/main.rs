//! Prints where the robot is: `cargo run -- [ENDPOINT [ID]]`.

use serde_json::{json, Value};
use zenoh::{Config, Wait};

fn main() -> zenoh::Result<()> {
    let mut words = std::env::args().skip(1);
    let endpoint = words.next().unwrap_or("tcp/127.0.0.1:7448".into());
    let robot = words.next().unwrap_or("acsar".into());

    let mut config = Config::default();
    config.insert_json5("mode", r#""client""#)?;
    config.insert_json5("connect/endpoints", &json!([endpoint]).to_string())?;

    let session = zenoh::open(config).wait()?;
    let key = format!("acsard/{robot}/json/odom");
    let odometry = session.declare_subscriber(key).wait()?;
    while let Ok(sample) = odometry.recv() {
        let odom: Value = serde_json::from_slice(&sample.payload().to_bytes())?;
        let at = &odom["pose"]["pose"]["position"];
        let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
        let speed = number(&odom["twist"]["twist"]["linear"]["x"]);
        println!("x {:.3} m, y {:.3} m, {speed:.3} m/s", number(&at["x"]), number(&at["y"]));
    }
    Ok(())
}
