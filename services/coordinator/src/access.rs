//! What each RPC and route asks of a caller: one table.
//!
//! **Closed by default**: what has no row here does not exist for anybody, whatever the router would do with it. Where a
//! row says [`Need::In`], the collection stands in the path of a route, where it is checked before the handler runs, or
//! in the message of an RPC, whose handler checks it with [`Caller`].

use std::collections::BTreeSet;

use axum::http::Method;
use ign_proto::{Cause, CollectionId, Grant, Scope};

use crate::http_answer::Refused;

/// What a request needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Need {
    /// Nothing.
    Open,
    /// Nothing from this machine; from elsewhere the scope in every collection.
    LocalOr(Scope),
    /// A token, whatever it allows.
    AnyToken,
    /// One of the scopes in the collection that path or message names.
    In(&'static [Scope]),
    /// The scope in every collection.
    Everywhere(Scope),
}

const ADMIN: Need = Need::In(&[Scope::Admin]);
const READ: Need = Need::In(&[Scope::Read]);
const SUBMIT: Need = Need::In(&[Scope::Submit]);
const PUBLISH: Need = Need::In(&[Scope::Publish]);
/// Workers read what the jobs that they hold need, and nothing else: see `App::may_fetch`.
const FETCH: Need = Need::In(&[Scope::Read, Scope::Publish]);
/// Whether something need be sent.
const PROBE: Need = Need::In(&[Scope::Read, Scope::Submit, Scope::Publish]);
const UPLOAD: Need = Need::In(&[Scope::Submit, Scope::Publish]);

/// Methods, path, need. Paths of routes are written as for the router.
pub(crate) const TABLE: &[(&str, &str, Need)] = &[
    ("GET", "/healthz", Need::Open),
    ("GET", "/readyz", Need::Open),
    ("GET", "/metrics", Need::LocalOr(Scope::Read)),
    ("POST", "/grpc.health.v1.Health/Check", Need::Open),
    ("POST", "/grpc.health.v1.Health/Watch", Need::Open),
    (
        "POST",
        "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
        Need::AnyToken,
    ),
    ("POST", "/ign.v1.Jobs/Submit", SUBMIT),
    ("POST", "/ign.v1.Jobs/SubmitBatch", SUBMIT),
    ("POST", "/ign.v1.Jobs/Get", READ),
    ("POST", "/ign.v1.Jobs/List", READ),
    ("POST", "/ign.v1.Jobs/Watch", READ),
    ("POST", "/ign.v1.Jobs/Logs", READ),
    ("POST", "/ign.v1.Jobs/Status", READ),
    ("POST", "/ign.v1.Jobs/Cancel", SUBMIT),
    ("POST", "/ign.v1.Jobs/Retry", SUBMIT),
    ("POST", "/ign.v1.Workers/Lease", PUBLISH),
    ("POST", "/ign.v1.Workers/Heartbeat", PUBLISH),
    ("POST", "/ign.v1.Workers/Checkpoint", PUBLISH),
    ("POST", "/ign.v1.Workers/Complete", PUBLISH),
    ("POST", "/ign.v1.Workers/Fail", PUBLISH),
    ("POST", "/ign.v1.Bundles/List", READ),
    ("POST", "/ign.v1.Bundles/Get", READ),
    ("POST", "/ign.v1.Bundles/SetAlias", ADMIN),
    ("POST", "/ign.v1.Bundles/Retire", ADMIN),
    ("POST", "/ign.v1.Bundles/Restore", ADMIN),
    ("POST", "/ign.v1.Collections/List", READ),
    ("POST", "/ign.v1.Collections/Set", ADMIN),
    ("POST", "/ign.v1.Collections/SetWebhook", ADMIN),
    ("POST", "/ign.v1.Collections/RemoveWebhook", ADMIN),
    ("POST", "/ign.v1.Collections/ListWebhooks", ADMIN),
    ("POST", "/ign.v1.Collections/ListDeliveries", ADMIN),
    ("POST", "/ign.v1.Collections/Redeliver", ADMIN),
    (
        "POST",
        "/ign.v1.Tokens/Create",
        Need::Everywhere(Scope::Admin),
    ),
    (
        "POST",
        "/ign.v1.Tokens/List",
        Need::Everywhere(Scope::Admin),
    ),
    (
        "POST",
        "/ign.v1.Tokens/Rotate",
        Need::Everywhere(Scope::Admin),
    ),
    (
        "POST",
        "/ign.v1.Tokens/Revoke",
        Need::Everywhere(Scope::Admin),
    ),
    (
        "POST",
        "/ign.v1.Admin/RebuildRegistry",
        Need::Everywhere(Scope::Admin),
    ),
    (
        "POST",
        "/ign.v1.Admin/CollectGarbage",
        Need::Everywhere(Scope::Admin),
    ),
    (
        "POST",
        "/ign.v1.Admin/AuditRegistry",
        Need::Everywhere(Scope::Admin),
    ),
    (
        "POST",
        "/ign.v1.Admin/ListEvents",
        Need::Everywhere(Scope::Admin),
    ),
    (
        "POST",
        "/ign.v1.Admin/DrainWorkers",
        Need::Everywhere(Scope::Admin),
    ),
    (
        "POST",
        "/ign.v1.Admin/Diagnose",
        Need::Everywhere(Scope::Admin),
    ),
    ("GET HEAD", "/v2/", Need::AnyToken),
    ("GET", "/v2/{collection}/{object}/blobs/{digest}", FETCH),
    ("HEAD", "/v2/{collection}/{object}/blobs/{digest}", PROBE),
    ("POST", "/v2/{collection}/{object}/blobs/uploads", UPLOAD),
    ("POST", "/v2/{collection}/{object}/blobs/uploads/", UPLOAD),
    (
        "GET HEAD PATCH PUT DELETE",
        "/v2/{collection}/{object}/blobs/uploads/{id}",
        UPLOAD,
    ),
    (
        "GET",
        "/v2/{collection}/{object}/manifests/{reference}",
        FETCH,
    ),
    (
        "HEAD",
        "/v2/{collection}/{object}/manifests/{reference}",
        PROBE,
    ),
    (
        "PUT",
        "/v2/{collection}/{object}/manifests/{reference}",
        SUBMIT,
    ),
    ("GET HEAD", "/v2/{collection}/{object}/tags/list", READ),
];

/// A row of the table, or why there is none.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Found {
    Need(Need),
    /// The path has rows, but none for this method.
    OtherMethod,
    Nothing,
}

/// What a request to this path needs; `route` is the router's pattern for it.
pub(crate) fn need(method: &Method, path: &str, route: Option<&str>) -> Found {
    let mut found = Found::Nothing;
    for (methods, row, need) in TABLE {
        let is_here = if row.contains('{') {
            route == Some(row)
        } else {
            path == *row
        };
        if is_here {
            if methods.split(' ').any(|it| it == method.as_str()) {
                return Found::Need(*need);
            }
            found = Found::OtherMethod;
        }
    }
    found
}

/// Who asks, and what they may do.
#[derive(Debug)]
pub(crate) struct Caller {
    /// A token's id, or a certificate's name; may be logged.
    pub(crate) name: String,
    grants: Vec<Grant>,
}

/// The collections in which a caller has a scope.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Reach {
    All,
    Within(BTreeSet<CollectionId>),
}

impl Reach {
    pub(crate) fn contains(&self, collection: &CollectionId) -> bool {
        match self {
            Self::All => true,
            Self::Within(collections) => collections.contains(collection),
        }
    }

    /// The collections where they are not all.
    pub(crate) fn only(&self) -> Option<&BTreeSet<CollectionId>> {
        match self {
            Self::All => None,
            Self::Within(collections) => Some(collections),
        }
    }

    /// Filters for listings: one for each collection, or a single one that lets all pass.
    pub(crate) fn each(&self) -> Vec<Option<CollectionId>> {
        match self {
            Self::All => vec![None],
            Self::Within(collections) => collections.iter().cloned().map(Some).collect(),
        }
    }

    /// One of them, or all that there are: what a listing is narrowed to.
    pub(crate) fn narrow(self, collection: Option<CollectionId>) -> Result<Self, Refused> {
        match collection {
            None => Ok(self),
            Some(name) if self.contains(&name) => Ok(Self::Within([name].into())),
            Some(name) => Err(forbidden(&[Scope::Read], &name)),
        }
    }
}

impl Caller {
    pub(crate) fn new(name: impl Into<String>, grants: Vec<Grant>) -> Self {
        Self {
            name: name.into(),
            grants,
        }
    }

    fn granted(&self, scope: Scope) -> impl Iterator<Item = &Grant> {
        self.grants
            .iter()
            .filter(move |grant| grant.scope == scope || grant.scope == Scope::Admin)
    }

    /// Where the caller has the scope.
    pub(crate) fn reach(&self, scope: Scope) -> Reach {
        let collections: Option<BTreeSet<CollectionId>> = self
            .granted(scope)
            .map(|grant| grant.collection.clone())
            .collect();
        collections.map_or(Reach::All, Reach::Within)
    }

    /// Whether the caller has the scope in the collection.
    pub(crate) fn may(&self, scope: Scope, collection: &CollectionId) -> bool {
        self.granted(scope)
            .any(|grant| grant.collection.as_ref().is_none_or(|it| it == collection))
    }

    /// Whether the caller has the scope in every collection.
    pub(crate) fn may_everywhere(&self, scope: Scope) -> bool {
        self.granted(scope).any(|grant| grant.collection.is_none())
    }

    /// Refuses unless the caller has one of the scopes in the collection.
    pub(crate) fn require(
        &self,
        scopes: &[Scope],
        collection: &CollectionId,
    ) -> Result<(), Refused> {
        if scopes.iter().any(|scope| self.may(*scope, collection)) {
            return Ok(());
        }
        Err(forbidden(scopes, collection))
    }

    /// Refuses what the need rules out; `collection` is the path's, where there is one.
    pub(crate) fn satisfy(
        &self,
        need: Need,
        collection: Option<&CollectionId>,
    ) -> Result<(), Refused> {
        match (need, collection) {
            (Need::Open | Need::AnyToken, _) => Ok(()),
            (Need::In(scopes), Some(collection)) => self.require(scopes, collection),
            // An RPC: its handler looks at the collection.
            (Need::In(scopes), None)
                if scopes
                    .iter()
                    .any(|scope| self.granted(*scope).next().is_some()) =>
            {
                Ok(())
            }
            (Need::In(scopes), None) => {
                Err(lacking(&format!("{} in any collection", words(scopes))))
            }
            (Need::Everywhere(scope) | Need::LocalOr(scope), _) if self.may_everywhere(scope) => {
                Ok(())
            }
            (Need::Everywhere(scope) | Need::LocalOr(scope), _) => {
                Err(lacking(&format!("{scope} in every collection")))
            }
        }
    }
}

fn words(scopes: &[Scope]) -> String {
    let words: Vec<&str> = scopes.iter().map(|scope| scope.as_str()).collect();
    words.join(" or ")
}

fn forbidden(scopes: &[Scope], collection: &CollectionId) -> Refused {
    lacking(&format!("{} in {collection}", words(scopes)))
}

fn lacking(what: &str) -> Refused {
    Refused(Cause::Forbidden {
        message: format!("the token does not allow this; it takes {what}"),
    })
}

#[cfg(test)]
mod tests {
    use ign_proto::v1;
    use prost::Message as _;

    use super::*;

    fn caller(grants: &[&str]) -> Caller {
        let grants = grants.iter().map(|grant| grant.parse().unwrap()).collect();
        Caller::new("test", grants)
    }

    #[test]
    fn every_rpc_of_the_schema_has_a_row_and_every_row_its_rpc() {
        let mut schema = BTreeSet::new();
        for set in [
            v1::FILE_DESCRIPTOR_SET,
            tonic_health::pb::FILE_DESCRIPTOR_SET,
            tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET,
        ] {
            for file in prost_types::FileDescriptorSet::decode(set).unwrap().file {
                for service in &file.service {
                    for method in &service.method {
                        schema.insert(format!(
                            "/{}.{}/{}",
                            file.package(),
                            service.name(),
                            method.name()
                        ));
                    }
                }
            }
        }
        let table: BTreeSet<String> = TABLE
            .iter()
            .filter(|(methods, ..)| *methods == "POST")
            .map(|(_, path, _)| (*path).to_owned())
            .filter(|path| !path.starts_with("/v2/"))
            .collect();
        assert_eq!(schema, table);
    }

    #[test]
    fn every_route_has_a_row_and_every_row_its_route() {
        let routes: BTreeSet<&str> = crate::data_plane::routes()
            .into_iter()
            .chain(crate::operations::routes())
            .map(|(path, _)| path)
            .collect();
        let table: BTreeSet<&str> = TABLE
            .iter()
            .map(|(_, path, _)| *path)
            .filter(|path| !path.starts_with("/ign.v1.") && !path.starts_with("/grpc."))
            .collect();
        assert_eq!(routes, table);
    }

    #[test]
    fn what_has_no_row_does_not_exist() {
        let blob = "/v2/{collection}/{object}/blobs/{digest}";
        let found = |method: Method, path: &str, route| need(&method, path, route);
        assert_eq!(
            found(Method::GET, "/v2/a/b/blobs/c", Some(blob)),
            Found::Need(FETCH)
        );
        assert_eq!(
            found(Method::DELETE, "/v2/a/b/blobs/c", Some(blob)),
            Found::OtherMethod
        );
        assert_eq!(found(Method::GET, "/new", Some("/new")), Found::Nothing);
        // A row with places is never taken at its word.
        assert_eq!(found(Method::GET, blob, None), Found::Nothing);
        assert_eq!(
            found(
                Method::POST,
                "/ign.v1.Jobs/New",
                Some("/ign.v1.Jobs/{*rest}")
            ),
            Found::Nothing
        );
    }

    #[test]
    fn grants_reach_as_far_as_they_say() {
        let museum: CollectionId = "museum".parse().unwrap();
        let library: CollectionId = "library".parse().unwrap();
        let mixed = caller(&["submit:museum", "read:*", "admin:library"]);
        assert!(mixed.may(Scope::Submit, &museum) && mixed.may(Scope::Submit, &library));
        assert!(!mixed.may(Scope::Admin, &museum) && !mixed.may(Scope::Publish, &museum));
        assert_eq!(mixed.reach(Scope::Read), Reach::All);
        assert_eq!(
            mixed.reach(Scope::Submit),
            Reach::Within([museum.clone(), library.clone()].into())
        );
        assert_eq!(
            caller(&[]).reach(Scope::Read),
            Reach::Within(BTreeSet::new())
        );
        assert!(mixed.satisfy(Need::Everywhere(Scope::Admin), None).is_err());
        assert!(mixed.satisfy(Need::LocalOr(Scope::Read), None).is_ok());
        assert!(mixed.satisfy(UPLOAD, Some(&museum)).is_ok());
        assert!(mixed.satisfy(PUBLISH, Some(&museum)).is_err());
        assert!(caller(&["read:museum"]).satisfy(PUBLISH, None).is_err());
        assert!(
            caller(&["read:museum"])
                .satisfy(FETCH, Some(&library))
                .is_err()
        );
    }
}
