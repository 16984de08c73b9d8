//! Camera drivers.
