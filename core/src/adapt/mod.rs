//! Observations and what they teach: bias, margin, drift, and the refusal of broken timings.
