"""Structure from motion on a session's photographs, brought to metres by the robot's poses."""
