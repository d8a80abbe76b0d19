# Nav2 of ROS 2 Jazzy from an archive of its installation, for machines that cannot have ros:jazzy:
#
#   UNDERSTUDY_NAV2_ARCHIVE=nav2.tar.zst scripts/images --load nav2
#
# The archive has a folder `nav2` with `nav2-launch` in it, built against the ROS wheels and the Python of the monitor's image.
ARG BASE_IMAGE=understudy/monitor
# Nav2 needs the ROS of that image and nothing of Understudy, so an image with the same ROS that changes less often may stand in for it.
ARG DEPENDENCIES_IMAGE=${BASE_IMAGE}

FROM ${DEPENDENCIES_IMAGE} AS unpacked
USER root
RUN apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends zstd
ARG ARCHIVE
COPY --from=archive ${ARCHIVE} /tmp/
RUN tar --zstd -xf "/tmp/${ARCHIVE}" -C /opt --exclude=nav2/include

FROM ${DEPENDENCIES_IMAGE}
USER root
RUN apt-get update -q && \
    DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends \
      libconsole-bridge1.0 libgraphicsmagick++-q16-12 liborocos-kdl1.5 libpython3.11 libuuid1 libyaml-cpp0.7 && \
    rm -rf /var/lib/apt/lists/*
COPY --from=unpacked /opt/nav2 /opt/nav2
COPY start-nav2 params.yml /opt/navigation/
ENV NAV2_VENV=/opt/understudy
USER 65532:65532
ENTRYPOINT ["/opt/navigation/start-nav2"]
