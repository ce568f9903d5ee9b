"""Who is part of the estimate, what is known of them, and the estimator that follows them."""
