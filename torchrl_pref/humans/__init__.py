"""Who answers: simulated humans."""
