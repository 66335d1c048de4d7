"""What a user states: the system, the rule by which functions get their arguments, signals, kinematics, and the checks at the border."""
