//! Longest-processing-time-first and queue orders for render farms.
