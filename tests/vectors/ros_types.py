"""ROS 2 (Jazzy) message and service definitions that acsard uses and does not define itself.

`acsard/core/ros/channels.py` has the other ones. Each type has one line: its name, a colon, and its
fields as `type name` with commas between them. A type without a package is a base type. `[]` is a
sequence, `[<=n]` is a bounded sequence, and `[n]` is an array. A service has `|` between request
and response.
"""

from __future__ import annotations

MESSAGES = """
nav2_msgs/msg/SpeedLimit: std_msgs/msg/Header header, bool percentage, float64 speed_limit
std_msgs/msg/Empty: uint8 structure_needs_at_least_one_member
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
