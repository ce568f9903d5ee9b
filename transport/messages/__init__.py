"""What packets say: header and bodies, encoded and decoded."""
