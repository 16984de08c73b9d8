//! Camera depth models.
