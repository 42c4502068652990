"""The ROS 2 message and service definitions (Jazzy) behind the types we speak, as facts.

One line a type: its name, a colon, its fields as `type name` with commas between. A type without
a package is a base type; `[]` is a sequence, `[<=n]` a bounded one, `[n]` an array. A service has
`|` between request and response.
"""

from __future__ import annotations

MESSAGES = """
builtin_interfaces/msg/Time: int32 sec, uint32 nanosec
std_msgs/msg/Header: builtin_interfaces/msg/Time stamp, string frame_id
geometry_msgs/msg/Vector3: float64 x, float64 y, float64 z
geometry_msgs/msg/Point: float64 x, float64 y, float64 z
geometry_msgs/msg/Quaternion: float64 x, float64 y, float64 z, float64 w
geometry_msgs/msg/Twist: geometry_msgs/msg/Vector3 linear, geometry_msgs/msg/Vector3 angular
geometry_msgs/msg/TwistStamped: std_msgs/msg/Header header, geometry_msgs/msg/Twist twist
geometry_msgs/msg/TwistWithCovariance: geometry_msgs/msg/Twist twist, float64[36] covariance
geometry_msgs/msg/Pose: geometry_msgs/msg/Point position, geometry_msgs/msg/Quaternion orientation
geometry_msgs/msg/PoseWithCovariance: geometry_msgs/msg/Pose pose, float64[36] covariance
geometry_msgs/msg/Transform: \
    geometry_msgs/msg/Vector3 translation, geometry_msgs/msg/Quaternion rotation
geometry_msgs/msg/TransformStamped: \
    std_msgs/msg/Header header, string child_frame_id, geometry_msgs/msg/Transform transform
nav_msgs/msg/Odometry: \
    std_msgs/msg/Header header, string child_frame_id, \
    geometry_msgs/msg/PoseWithCovariance pose, geometry_msgs/msg/TwistWithCovariance twist
tf2_msgs/msg/TFMessage: geometry_msgs/msg/TransformStamped[] transforms
sensor_msgs/msg/Imu: \
    std_msgs/msg/Header header, \
    geometry_msgs/msg/Quaternion orientation, float64[9] orientation_covariance, \
    geometry_msgs/msg/Vector3 angular_velocity, float64[9] angular_velocity_covariance, \
    geometry_msgs/msg/Vector3 linear_acceleration, float64[9] linear_acceleration_covariance
sensor_msgs/msg/JointState: \
    std_msgs/msg/Header header, string[] name, \
    float64[] position, float64[] velocity, float64[] effort
diagnostic_msgs/msg/KeyValue: string key, string value
diagnostic_msgs/msg/DiagnosticStatus: \
    byte level, string name, string message, string hardware_id, \
    diagnostic_msgs/msg/KeyValue[] values
diagnostic_msgs/msg/DiagnosticArray: \
    std_msgs/msg/Header header, diagnostic_msgs/msg/DiagnosticStatus[] status
service_msgs/msg/ServiceEventInfo: \
    uint8 event_type, builtin_interfaces/msg/Time stamp, char[16] client_gid, int64 sequence_number
rcl_interfaces/msg/FloatingPointRange: float64 from_value, float64 to_value, float64 step
rcl_interfaces/msg/IntegerRange: int64 from_value, int64 to_value, uint64 step
rcl_interfaces/msg/ParameterDescriptor: \
    string name, uint8 type, string description, string additional_constraints, \
    bool read_only, bool dynamic_typing, \
    rcl_interfaces/msg/FloatingPointRange[<=1] floating_point_range, \
    rcl_interfaces/msg/IntegerRange[<=1] integer_range
rcl_interfaces/msg/ParameterValue: \
    uint8 type, bool bool_value, int64 integer_value, float64 double_value, string string_value, \
    byte[] byte_array_value, bool[] bool_array_value, int64[] integer_array_value, \
    float64[] double_array_value, string[] string_array_value
rcl_interfaces/msg/Parameter: string name, rcl_interfaces/msg/ParameterValue value
rcl_interfaces/msg/SetParametersResult: bool successful, string reason
rcl_interfaces/msg/ListParametersResult: string[] names, string[] prefixes
"""

SERVICES = """
std_srvs/srv/Trigger: | bool success, string message
rcl_interfaces/srv/DescribeParameters: \
    string[] names | rcl_interfaces/msg/ParameterDescriptor[] descriptors
rcl_interfaces/srv/GetParameters: string[] names | rcl_interfaces/msg/ParameterValue[] values
rcl_interfaces/srv/GetParameterTypes: string[] names | uint8[] types
rcl_interfaces/srv/ListParameters: \
    string[] prefixes, uint64 depth | rcl_interfaces/msg/ListParametersResult result
rcl_interfaces/srv/SetParameters: \
    rcl_interfaces/msg/Parameter[] parameters | rcl_interfaces/msg/SetParametersResult[] results
rcl_interfaces/srv/SetParametersAtomically: \
    rcl_interfaces/msg/Parameter[] parameters | rcl_interfaces/msg/SetParametersResult result
"""
