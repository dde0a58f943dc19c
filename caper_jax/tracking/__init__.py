"""Pose tracking (paper Sec 5.3): proxy canonicalization, pose increments, dynamic keyframes."""
