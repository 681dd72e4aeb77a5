"""What is known of poses and depths at a solution, and of the errors that all matches share."""
