"""A robot whose health trees have every leaf that looks at an application, in both languages besides the short form.

Its application (applications/observed.py) breaks one thing at a time, while it goes on driving.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tests.e2e.kubectl import Object
from tests.e2e.scenario import CONTAINER, Robot, manifest

APPLICATION = Path(__file__).parent / "applications" / "observed.py"

IMAGE = "localhost/understudy-navigation:dev"
"""An image with rclpy and tf2_msgs, which also serves as the monitor's."""

SPEED = 0.0625
"""Metres per second that the procedures set. It is a binary fraction, so each language and the robot's log write the same number."""

GRACE = "15s"
"""Time from a takeover until what an instance logs is a failure: it may log errors while it starts. The next failure may come sooner."""

TREES: Mapping[str, str] = {
    "xml": """
        <root BTCPP_format="4" main_tree_to_execute="Healthy">
          <BehaviorTree ID="Healthy">
            <Parallel>
              <Topic topic="/cmd_vel" gap="4s"/>
              <Value topic="/charge" type="std_msgs/msg/Float32" holds="data &gt; 0.25" for="300ms"/>
              <Age topic="/measured" type="geometry_msgs/msg/PointStamped" most="20s"/>
              <Diagnostics status="drive: motor" worst="WARN"/>
              <Transform parent="odom" child="base_link" gap="4s"/>
              <Publisher topic="/plan" node="/observed" for="1s"/>
            </Parallel>
          </BehaviorTree>
        </root>
        """,
    "osc": """
import osc.understudy

scenario healthy:
    do parallel:
        topic("/cmd_vel", gap: 4s)
        node("/helper", for: 1s)
        log(level: severity!ERROR, node: "/observed", says: "motor is hot")
        progress("/work", "test_msgs/action/Fibonacci", grows: "sequence[-1]", by: 1.0, within: 4s)
        lifecycle("/guide", lifecycle_state!active, for: 500ms)
        parameter("/observed", "speed", equals: "0.0625")
""",
}
"""Health trees by language. Half of the leaves are in each, so that every one of them shows both its kind and its language. Times leave
room for what is only late on a busy machine.
"""

BRING_UPS: Mapping[str, str] = {
    "xml": """
        <root BTCPP_format="4" main_tree_to_execute="BringUp">
          <BehaviorTree ID="BringUp">
            <Sequence>
              <SetParameters node="/observed" values='json:{"speed": 0.0625}'/>
              <CallService service="/begin" type="std_srvs/srv/Trigger" expect='json:{"success": true}' repeat="5s"/>
            </Sequence>
          </BehaviorTree>
        </root>
        """,
    "osc": """
import osc.understudy

scenario bring_up:
    do serial:
        set_parameters("/observed", "{speed: 0.0625}")
        call_service("/begin", "std_srvs/srv/Trigger", expect: "{success: true}", repeat: 5s)
""",
}

CHECK = """
    <root BTCPP_format="4" main_tree_to_execute="Waits">
      <BehaviorTree ID="Waits">
        <Sequence>
          <ServicePresent service="/begin"/>
          <ParameterIs node="/observed" parameter="mode" value="auto"/>
        </Sequence>
      </BehaviorTree>
    </root>
    """
"""What a standby of the robot with XML must be like to count."""


class ObservedRobot(Robot):
    """One robot with an executing standby, and what its application can break."""

    def break_(self, pod: str, what: str) -> None:
        """Break what has this name in the instance in a pod."""
        self.kubectl.shell(pod, CONTAINER, 'echo "$1" >/tmp/fault', what)

    def mend(self, pod: str) -> None:
        """Undo what can be undone."""
        self.kubectl.shell(pod, CONTAINER, "rm -f /tmp/fault")

    def observed(self, language: str) -> list[Object]:
        """Return the robot, its workload, and their policy and pool, with the trees in one language."""

        def edit(workload: Object) -> None:
            spec = workload["spec"]
            spec["monitor"] = {"image": IMAGE}
            spec["bringUp"] = {"within": "30s", language: BRING_UPS[language]}
            pod = spec["template"]["spec"]
            (container,) = pod["containers"]
            container |= {"image": IMAGE, "command": ["python3", "/application/observed.py"]}
            container["volumeMounts"] = [{"name": "application", "mountPath": "/application"}]
            pod["volumes"] = [{"name": "application", "configMap": {"name": "application"}}]

        policy, pool = manifest("strategies/executing.yaml")
        policy["spec"]["monitoring"] = {language: TREES[language], "startupGrace": GRACE}
        if language == "xml":
            pool["spec"]["readinessCheck"] = {"period": "1s", "xml": CHECK}
        source = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "application"}}
        source["data"] = {APPLICATION.name: APPLICATION.read_text()}
        return [source, policy, pool, *self.objects(policy=policy["metadata"]["name"], edit=edit)]
