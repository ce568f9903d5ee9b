"""Who may say it: keys, signatures, envelopes, replay protection, sealing and opening."""
