"""Has the camera been here before? Keyframes, candidates, their verification, and what loops say together."""
