//! Plan, train, evaluate and report one object.
