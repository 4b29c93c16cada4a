//! Wire types of ign.v1, identifiers, and the mapping of errors to gRPC status.
