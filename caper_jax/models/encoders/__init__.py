"""Point-cloud encoders: the HS-Encoder of the paper and the fast one."""
