"""From photographs or a video to a COLMAP capture: structure from motion, undistortion, and a report."""
