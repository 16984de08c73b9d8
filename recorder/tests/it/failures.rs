//! What goes wrong is said, counted and survived.
