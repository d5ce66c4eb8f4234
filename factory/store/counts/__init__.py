"""What the tables come to: attempts as columns, the funnel, the balance of what was planned."""
