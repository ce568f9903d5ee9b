"""Windows whose first state and accelerations are both free, solved by ours, by IPOPT and by acados."""
