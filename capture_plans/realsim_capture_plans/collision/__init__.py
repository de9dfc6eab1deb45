"""What the arm may run into: shapes of arm, camera and mount, the work cell, clearances."""
