//! `ign.v1.Bundles`: what is published, and under which names.

use std::sync::Arc;

use ign_proto::v1::bundles_server::Bundles;
use ign_proto::{Cause, Manifest, Scope, v1};
use ign_queue::{Version, VersionFilter};
use ign_registry::RegistryError;
use tonic::{Request, Response, Status};

use crate::app::App;
use crate::auth::caller;
use crate::convert::{object_name, optional, to_bundle};
use crate::http_answer::Refused;

type Answer<T> = Result<Response<T>, Status>;

/// Serves `ign.v1.Bundles`.
pub(crate) struct BundlesApi(pub(crate) Arc<App>);

impl BundlesApi {
    async fn record(&self, kind: &str, version: &Version) -> Result<(), Refused> {
        let subject = format!("{}:v{}", version.object, version.version);
        let recorded = self.0.store.record(kind, &subject, "on request").await;
        Ok(recorded?)
    }
}

impl App {
    /// Fails unless all files of a version are there.
    pub(crate) async fn check_files(&self, version: &Version) -> Result<(), Refused> {
        let gone = || {
            Refused(Cause::NotAllowed {
                reason: "FILES_COLLECTED".to_owned(),
                message: format!(
                    "files of {}:v{} were collected after it was retired",
                    version.object, version.version
                ),
            })
        };
        let digest = &version.bundle.manifest_digest;
        let bytes = self.registry.manifest(digest).await?.ok_or_else(gone)?;
        match self.registry.check_blobs(&Manifest::decode(&bytes)?).await {
            Ok(()) => Ok(()),
            Err(RegistryError::BlobsMissing { .. }) => Err(gone()),
            Err(error) => Err(error.into()),
        }
    }
}

#[tonic::async_trait]
impl Bundles for BundlesApi {
    async fn list(
        &self,
        request: Request<v1::ListBundlesRequest>,
    ) -> Answer<v1::ListBundlesResponse> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let reach = caller
            .reach(Scope::Read)
            .narrow(optional(&request.collection, "collection")?)?;
        let object = optional(&request.object, "object")?;
        let mut versions = Vec::new();
        for collection in reach.each() {
            let filter = VersionFilter {
                collection,
                object: object.clone(),
                include_retired: request.include_retired,
            };
            let found = self.0.store.versions(&filter).await;
            versions.extend(found.map_err(Refused::from)?);
        }
        Ok(Response::new(v1::ListBundlesResponse {
            bundles: versions.into_iter().map(to_bundle).collect(),
        }))
    }

    async fn get(&self, request: Request<v1::GetBundleRequest>) -> Answer<v1::BundleVersion> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let object = object_name(request.object.as_ref())?;
        caller.require(&[Scope::Read], &object.collection)?;
        let version = self
            .0
            .store
            .version(&object, &request.reference)
            .await
            .map_err(Refused::from)?;
        Ok(Response::new(to_bundle(version)))
    }

    async fn set_alias(&self, request: Request<v1::SetAliasRequest>) -> Answer<v1::BundleVersion> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let object = object_name(request.object.as_ref())?;
        caller.require(&[Scope::Admin], &object.collection)?;
        let version = self
            .0
            .store
            .set_alias(&object, &request.reference, &request.alias)
            .await
            .map_err(Refused::from)?;
        self.0.mirror(&object).await;
        tracing::info!(object = %object, version = version.version, alias = request.alias, "alias moved");
        Ok(Response::new(to_bundle(version)))
    }

    async fn retire(&self, request: Request<v1::GetBundleRequest>) -> Answer<v1::BundleVersion> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let object = object_name(request.object.as_ref())?;
        caller.require(&[Scope::Admin], &object.collection)?;
        let version = self
            .0
            .store
            .retire(&object, &request.reference)
            .await
            .map_err(Refused::from)?;
        self.0.mirror(&object).await;
        tracing::info!(object = %object, version = version.version, "version retired");
        self.record("retire", &version).await?;
        Ok(Response::new(to_bundle(version)))
    }

    async fn restore(&self, request: Request<v1::GetBundleRequest>) -> Answer<v1::BundleVersion> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let object = object_name(request.object.as_ref())?;
        caller.require(&[Scope::Admin], &object.collection)?;
        let app = &self.0;
        let version = app
            .store
            .version(&object, &request.reference)
            .await
            .map_err(Refused::from)?;
        app.check_files(&version).await?;
        let version = app
            .store
            .restore(&object, &format!("v{}", version.version))
            .await
            .map_err(Refused::from)?;
        app.mirror(&object).await;
        tracing::info!(object = %object, version = version.version, "version restored");
        self.record("restore", &version).await?;
        Ok(Response::new(to_bundle(version)))
    }
}
