//! Coordinator: gRPC control plane and HTTP data plane on one port.
