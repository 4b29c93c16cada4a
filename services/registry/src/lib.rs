//! Content-addressed blobs, manifests, versions and aliases on an object store.
