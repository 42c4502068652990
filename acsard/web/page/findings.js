// Written by `python -m tests.tools.tables` from the tables of acsard/core/tables.

/** Maps a code to its short form, and to the advice if that needs no values. */
export const FINDINGS = {
  emergency_stop: ["emergency stop pressed", "release it at the robot"],
  emergency_stop_silent: ["emergency stop not reported", "check the board and its cable"],
  bumper: ["bumper pressed", "release it at the robot"],
  battery_empty: ["battery empty", ""],
  battery_low: ["battery low", "charge the battery"],
  battery_unknown: ["battery level unknown", ""],
  wheel_fault: ["wheel fault", ""],
  counts_and_speeds_differ: ["pose doubtful", "write the counts per turn of a wheel that `acsard mcu check` shows; if they are right, correct the speeds in the firmware"],
  wheels_and_commands_differ: ["pose doubtful", "repair the wheel that a fault has named. Else measure a straight drive with a tape: if the pose is wrong, correct the encoders or the speeds in the firmware, else the speed control of the motors. Then type `acsard call set_pose`, which ends this warning"],
  encoder_counts_missing: ["pose doubtful", "write the counts per turn of a wheel; `acsard mcu check` shows about how many they are"],
  gyro_disagrees: ["pose doubtful", "if the wheels do not slip, measure the track with `acsard calibrate drive`, let the robot stand so that it learns the gyro's bias, and check that the gyro's z axis points up and that it sends rad/s"],
  not_calibrated: ["not calibrated", "type `acsard calibrate drive`"],
  coarse_encoder: ["pose doubtful", "flash the C firmware of deploy/firmware, and write mcu.link_check = \"on\" and mcu.encoder_counts: its lines have counts, which no lost or late line can falsify"],
  recording_fails: ["recording fails", "free disk space, or set record.directory to a writable directory"],
  latch_file_fails: ["latch file fails", "free disk space, or set control.state_directory to a writable directory"],
};

/** Map a level of the battery, or a state of the emergency stop, to its code. */
export const BATTERY = {"warning": "battery_low", "stop": "battery_empty", "unknown": "battery_unknown"};
export const ESTOP = {"pressed": "emergency_stop", "silent": "emergency_stop_silent"};
