"""Pose tracking (paper Sec 5.3): proxy canonicalisation, pose increments, dynamic keyframes."""
