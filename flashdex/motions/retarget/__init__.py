"""From human keypoints to joints of the robot hand, with contact."""
