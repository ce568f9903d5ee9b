"""What the autopilot is given of the estimate: encoding, the gatekeeper before it, and whether it is used.

Nothing is fed unless ``[feedback]`` asks for it. All sans-I/O: messages, samples, estimates and instants in, messages
out. `feeder` puts the parts together for `agent.onboard`.
"""
